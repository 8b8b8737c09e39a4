"""Runs the console until it is stopped."""

import asyncio
import logging
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

import uvicorn

from terrafix.core.errors import LinkError, OutputError
from terrafix_tools.console.app import make_app
from terrafix_tools.console.service import Service
from terrafix_tools.console.settings import Settings

KEEP_ALIVE_S = 15  # idle connections are closed after this time
STOP_S = 10  # longest wait for requests in progress at a stop


class Server(uvicorn.Server):
    """Ends the event streams at a stop, which would never end by themselves."""

    service: Service

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """As in uvicorn, but a signal that has ended the service in order is not raised again."""
        before = {number: signal.signal(number, self.handle_exit) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        self.service.feeds.close()
        super().handle_exit(sig, frame)


def serve(settings: Settings) -> None:
    """Until SIGINT or SIGTERM. Raises UsageError, ConfigError, OutputError, LinkError (the port is taken)."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    try:
        settings.data.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise OutputError(f"{settings.data}: cannot be made ({error.strerror}); choose another --data") from None
    app = make_app(settings)
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        log_level="warning",
        access_log=False,
        server_header=False,
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=STOP_S,
        ssl_certfile=settings.cert,
        ssl_keyfile=settings.key,
    )
    server = Server(config)
    server.service = app.state.service
    try:
        asyncio.run(server.serve())
    except SystemExit:
        raise LinkError(
            f"port {settings.port} of {settings.host} cannot be opened; is it taken? choose --port"
        ) from None
