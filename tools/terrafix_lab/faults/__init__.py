"""The faults of simulated flights: one table for acceptance, Monte Carlo, closed loop and the fault matrix."""
