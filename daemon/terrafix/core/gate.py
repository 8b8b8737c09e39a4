"""How far off is too far: chi-square at 99.9 %, by degrees of freedom, for squared Mahalanobis distances."""

GATE = {2: 13.82, 3: 16.27, 6: 22.46, 7: 24.32}

# Of a mixture: a component of less than this weight is left out. A 95 % ellipse about the others is one without it.
LEAST_WEIGHT = 0.05
