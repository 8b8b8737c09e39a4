"""Entry point `terrafix`.

`run` may be a restart in flight, so its start-up time matters: the fork server, which imports what the processes need,
starts before the command line is loaded and imports in parallel with it.
"""

import sys

INTERRUPTED = 130  # exit code after Ctrl-C, as of the command line itself [spec: 128 + SIGINT]


def main() -> None:
    try:
        _main()
    except KeyboardInterrupt:  # while the command line was loaded
        sys.exit(INTERRUPTED)


def _main() -> None:
    if sys.argv[1:2] != ["run"]:
        from terrafix_tools import cli

        cli.main()
        return
    from terrafix.runtime.fork_server import ForkServer

    with ForkServer() as fork_server:
        from terrafix_tools import cli

        cli.main(fork_server)


if __name__ == "__main__":
    main()
