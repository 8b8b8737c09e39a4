"""Alembic migrations of the console's database."""
