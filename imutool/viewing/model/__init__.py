"""What a picture of a log shows, free of any viewer."""
