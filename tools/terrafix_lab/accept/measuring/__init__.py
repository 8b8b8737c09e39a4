"""How the numbers of acceptance are measured and judged."""
