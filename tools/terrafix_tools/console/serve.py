"""Runs the console until it is stopped."""

import asyncio
import logging
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

import typer
import uvicorn
from fastapi import FastAPI

from terrafix.core.errors import LinkError, OutputError
from terrafix_tools.console.app import make_app
from terrafix_tools.console.connections import BoundedProtocol
from terrafix_tools.console.service import Service
from terrafix_tools.console.settings import Settings
from terrafix_tools.parallel.scheduler import check_scheduler

KEEP_ALIVE_S = 15  # idle connections are closed after this time
STOP_S = 10  # longest wait for requests in progress at a stop


class Server(uvicorn.Server):
    """Ends the event streams at a stop, which would never end by themselves."""

    def __init__(self, config: uvicorn.Config, service: Service) -> None:
        super().__init__(config)
        self._service = service
        self._loop: asyncio.AbstractEventLoop | None = None

    async def serve(self, sockets: list[socket.socket] | None = None) -> None:
        self._loop = asyncio.get_running_loop()
        await super().serve(sockets)

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """As in uvicorn, but a signal that has ended the service in order is not raised again."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self.handle_exit) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        super().handle_exit(sig, frame)
        self.end()

    def end(self) -> None:
        """From any thread, or a signal."""
        self.should_exit = True
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._service.feeds.close)


def config_of(app: FastAPI, settings: Settings) -> uvicorn.Config:
    return uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        http=BoundedProtocol,
        log_level="warning",
        access_log=False,
        server_header=False,
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=STOP_S,
        ssl_certfile=settings.cert,
        ssl_keyfile=settings.key,
    )


def serve(settings: Settings) -> None:
    """Until SIGINT or SIGTERM. Raises UsageError, ConfigError, OutputError, LinkError (the port is taken)."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    try:
        settings.data.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise OutputError(f"{settings.data}: cannot be made ({error.strerror}); choose another --data") from None
    if settings.scheduler:
        check_scheduler(settings.scheduler)
    app = make_app(settings)
    server = Server(config_of(app, settings), app.state.service)
    print_address(settings)
    try:
        asyncio.run(server.serve())
    except SystemExit:
        raise LinkError(
            f"port {settings.port} of {settings.host} cannot be opened; is it taken? choose --port"
        ) from None


def print_address(settings: Settings) -> None:
    scheme = "http" if settings.cert is None else "https"
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    typer.echo(f"{scheme}://{host}:{settings.port}/", err=True)
