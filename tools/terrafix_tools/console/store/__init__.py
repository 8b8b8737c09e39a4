"""What the console keeps: flights, images, results, fragments, headings, hints and events, in one SQLite file."""
