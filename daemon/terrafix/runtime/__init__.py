"""What forks, waits or writes: the supervisor, the processes, the bus, the shells."""
