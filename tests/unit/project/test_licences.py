"""Licences of what an installation brings: known, allowed, and the ones that the page states."""

import re

import pytest

import licences

LOCK = (licences.ROOT / "requirements.lock").read_text(encoding="utf-8")
# On some interpreters only: the page has those of the one that wrote it.
SOMETIMES = set(re.findall(r"^([\w.-]+)==[^;\n]+;", LOCK, flags=re.M))


def test_every_package_has_a_licence_that_may_be_shipped() -> None:
    packages = licences.packages()
    assert {"numpy", "rasterio", "fastapi", "pymavlink", "tornado"} <= set(packages), "with what those need"
    assert [name for name in packages if not licences.is_allowed(licences.licence_of(name))] == []


@pytest.mark.parametrize("expression", ["GPL-3.0-only", "AGPL-3.0-only", "MIT AND GPL-2.0-or-later", "unknown", ""])
def test_gpl_and_unknown_licences_are_refused(expression: str) -> None:
    assert not licences.is_allowed(expression)


@pytest.mark.parametrize("expression", ["MIT", "LGPL-3.0-only", "Apache-2.0 OR GPL-2.0-only", "BSD-3-Clause AND MIT"])
def test_a_licence_with_an_allowed_alternative_is_taken(expression: str) -> None:
    assert licences.is_allowed(expression)


def test_the_page_has_the_licences_that_are_installed() -> None:
    written, installed = licences.written(), licences.packages()
    assert {name for name in {*written, *installed} if written.get(name) != installed.get(name)} <= SOMETIMES, (
        "run python tests/rigs/licences.py"
    )
