"""Whether a map will do, and pictures of it."""
