"""User errors of the training: one line with the problem, its location and the remedy."""


class TrainingError(Exception):
    pass
