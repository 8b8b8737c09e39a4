"""What the console keeps: flights, images, results, fragments, hints and events, in one SQLite file."""
