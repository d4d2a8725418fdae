"""Tables of numbers. Rooms, lowest first: text, columns, files, recordings."""
