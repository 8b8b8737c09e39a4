"""The layer above the operating system: supervisor, processes, message bus, shells, files of a run."""
