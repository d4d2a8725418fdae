"""What columns hold: times, rates, accelerations, poses, and their units."""
