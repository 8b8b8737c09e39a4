"""Several images as one."""
