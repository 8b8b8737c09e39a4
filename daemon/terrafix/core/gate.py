"""Innovation gates: limits of the squared Mahalanobis distance, and the least weight of a mixture component."""

import math

# Chi-square quantile at 95 %, two degrees of freedom: limit of the squared Mahalanobis distance inside the 95 % ellipse
# of a horizontal position, and the radius of its circle over the 1-sigma of each axis. [spec: chi-square distribution]
CHI2_95 = 5.991
SIGMAS_95 = math.sqrt(CHI2_95)

# Chi-square quantiles at 99.9 % by degrees of freedom. [spec: chi-square distribution]
GATE = {1: 10.83, 2: 13.82, 3: 16.27, 6: 22.46, 7: 24.32}

# Components of a Gaussian mixture below this weight are neglected: a 95 % confidence ellipse may leave out 5 % of the
# probability. [spec: 95 % confidence level]
MIN_COMPONENT_WEIGHT = 0.05
