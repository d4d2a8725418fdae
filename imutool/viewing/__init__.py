"""What a person looks at: the data behind every picture, and the viewer that shows it."""
