"""Factors that GTSAM lacks, one file each. Variables C_k, B_k, V_k: see terrafix.estimator.state."""
