"""The program `terrafix`: its command line, and for `run` first what takes longest.

A vehicle waits when it is started again in flight. The fork_server imports what the processes need; it is begun before
the command line is loaded, and imports beside that."""

import sys


def main() -> None:
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
