"""`terrafix compare A B`: where two records of one flight diverge, and by how much."""
