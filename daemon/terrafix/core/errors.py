"""The exception tree. The command line catches TerrafixError in one place, prints it and exits with ``exit_code``.

TerrafixError
+-- UsageError            2   wrong arguments
+-- ConfigError           3   a configuration file: unknown key, out of bounds, not readable
+-- SourceError           4   a flight, photo folder, video or camera that cannot be opened
+-- MapError              5   a map that is missing, broken, or does not cover the start
+-- OutputError           6   an output that cannot be written
+-- LinkError             7   a MAVLink connection that cannot be opened
+-- ModelError            8   a model file that is missing, altered or of the wrong shape
+-- EvaluationError       9   truth and estimates that do not belong together

Each message states what is wrong, where, and what to do next. Other exceptions are bugs and end in a traceback."""


class TerrafixError(Exception):
    """A user error or a missing resource, as opposed to a bug."""

    exit_code = 1


class UsageError(TerrafixError):
    exit_code = 2


class ConfigError(TerrafixError):
    exit_code = 3


class SourceError(TerrafixError):
    exit_code = 4


class MapError(TerrafixError):
    exit_code = 5


class OutputError(TerrafixError):
    exit_code = 6


class LinkError(TerrafixError):
    exit_code = 7


class ModelError(TerrafixError):
    exit_code = 8


class EvaluationError(TerrafixError):
    exit_code = 9


ERROR_OF_EXIT_CODE = {kind.exit_code: kind for kind in TerrafixError.__subclasses__()}
