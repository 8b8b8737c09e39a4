"""`terrafix replay RECORD`: the estimator once more, from the messages of a flight record."""
