"""The application: routes, guard, page, and its life."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from fastapi import FastAPI
from starlette.middleware import Middleware
from starlette.staticfiles import StaticFiles

from terrafix import __version__
from terrafix_tools.console.access import LOOPBACK, access_of
from terrafix_tools.console.guard import Guard
from terrafix_tools.console.problems import add_handlers
from terrafix_tools.console.routes import router
from terrafix_tools.console.service import Service
from terrafix_tools.console.settings import Settings
from terrafix_tools.console.store.database import open_database

PAGE = Path(__file__).parent / "page"


def make_app(settings: Settings) -> FastAPI:
    """The service with its database open. Raises UsageError, ConfigError, OutputError."""
    access = access_of(settings)
    settings.flights.mkdir(parents=True, exist_ok=True)
    service = Service(settings, open_database(settings.data), access)

    @asynccontextmanager
    async def life(_app: FastAPI) -> AsyncIterator[None]:
        await service.start()
        yield
        await service.stop()

    hosts = () if access.required else (*LOOPBACK, settings.host, *settings.hosts)
    guard = Middleware(Guard, access=access, hosts=hosts, body_bytes=settings.limits.body_bytes)
    app = FastAPI(
        title="Terrafix console",
        version=__version__,
        docs_url=None,  # their assets come from another host
        redoc_url=None,
        lifespan=life,
        middleware=[guard],
    )
    app.state.service = service
    add_handlers(app)
    app.include_router(router)
    app.mount("/page", StaticFiles(directory=PAGE, html=True), name="page")
    return app
