"""What a user of the training can get wrong: one line, what, where, and what to do next."""


class TrainingError(Exception):
    pass
