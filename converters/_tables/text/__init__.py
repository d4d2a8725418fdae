"""Tables of text: delimiters, headers, numbers, dates, and the words in names of columns."""
