"""`terrafix models fetch`: whole and right under its own name, or not at all."""

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

import tiny_onnx
from map_servers import Asked, Reply, serving
from terrafix.core.errors import ModelError, OutputError, TerrafixError
from terrafix_tools.models import download
from terrafix_tools.models.cli import app
from terrafix_tools.models.fetch import fetch_all

CONTENT = tiny_onnx.xfeat_like()


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(download, "FIRST_WAIT_S", 0.001)
    for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A models folder that knows a model `tiny`, whose file is not there."""
    folder = tmp_path / "models"
    folder.mkdir()
    tiny_onnx.write(folder, tiny_onnx.XFEAT_LIKE, CONTENT).unlink()
    return folder


def fetch(folder: Path, source: object) -> None:
    fetch_all(["tiny"], str(source), str(folder))


def ranged(asked: Asked, content: bytes = CONTENT) -> Reply:
    """A server that knows ranges."""
    wanted = asked.headers.get("Range", "")
    if not wanted:
        return Reply(body=content)
    start = int(wanted.removeprefix("bytes=").rstrip("-"))
    told = {"Content-Range": f"bytes {start}-{len(content) - 1}/{len(content)}"}
    return Reply(status=206, body=content[start:], headers=told)


def test_a_file_comes_whole(folder: Path) -> None:
    with serving(ranged) as server:
        fetch(folder, f"{server.url}/tiny.onnx")
    assert (folder / "tiny.onnx").read_bytes() == CONTENT
    assert sorted(path.name for path in folder.iterdir()) == ["tiny.onnx", "tiny.toml"]


def test_it_goes_on_where_it_was_cut_off(folder: Path) -> None:
    def cut(asked: Asked) -> Reply:
        reply = ranged(asked)
        reply.promised = len(reply.body)
        reply.body = reply.body[:9000]
        return reply

    with serving(cut) as server:
        fetch(folder, f"{server.url}/tiny.onnx")
        ranges = [asked.headers.get("Range", "") for asked in server.asked]
    assert (folder / "tiny.onnx").read_bytes() == CONTENT
    assert ranges[:3] == ["", "bytes=9000-", "bytes=18000-"]


def test_a_later_run_goes_on_too_and_a_stranger_is_started_anew(folder: Path) -> None:
    part = folder / "tiny.onnx.part"
    for begun, requests in ((CONTENT[:500], 1), (b"another file", 2)):
        (folder / "tiny.onnx").unlink(missing_ok=True)
        part.write_bytes(begun)
        with serving(ranged) as server:
            fetch(folder, f"{server.url}/tiny.onnx")
            assert server.asked[0].headers["Range"] == f"bytes={len(begun)}-" and len(server.asked) == requests
        assert (folder / "tiny.onnx").read_bytes() == CONTENT and not part.exists()


def test_a_server_without_ranges_sends_it_all_again(folder: Path) -> None:
    (folder / "tiny.onnx.part").write_bytes(b"x" * 500)
    with serving(lambda _: Reply(body=CONTENT)) as server:
        fetch(folder, f"{server.url}/tiny.onnx")
    assert (folder / "tiny.onnx").read_bytes() == CONTENT


def test_a_server_that_recovers_is_asked_again(folder: Path) -> None:
    replies = iter([Reply(status=503), Reply(status=429)])
    with serving(lambda asked: next(replies, None) or ranged(asked)) as server:
        fetch(folder, f"{server.url}/tiny.onnx")
    assert (folder / "tiny.onnx").read_bytes() == CONTENT


def always_cut(_: Asked) -> Reply:
    return Reply(body=CONTENT[:100], promised=len(CONTENT))


ALTERED = CONTENT[:-1] + b"?"


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (lambda _: Reply(status=404), "the server refuses (status 404); check the address"),
        (lambda _: Reply(status=500), "the server says 500, 0.0 of 0.1 MB are here; run it again"),
        (always_cut, "the answer was cut off, 0.0 of 0.1 MB are here; run it again to go on"),
        (lambda _: Reply(body=b"<html>no</html>"), "has 15 bytes, the published file"),
        (lambda _: Reply(body=CONTENT + b"more"), "the published file"),
        (lambda _: Reply(body=ALTERED), "not the published file (sha256"),
    ],
)
def test_what_goes_wrong_is_told_and_leaves_nothing_under_the_name(
    folder: Path, answer: Callable[[Asked], Reply], says: str
) -> None:
    with serving(answer) as server, pytest.raises(ModelError) as error:
        fetch(folder, f"{server.url}/tiny.onnx")
    assert says in str(error.value) and "\n" not in str(error.value)
    assert not (folder / "tiny.onnx").exists()


def test_no_network(folder: Path) -> None:
    with serving(ranged) as server:
        url = server.url
    with pytest.raises(ModelError, match=r"no connection, 0\.0 of .* or give a file with --from"):
        fetch(folder, f"{url}/tiny.onnx")
    assert [path.name for path in folder.iterdir()] == ["tiny.toml"]


def test_from_a_folder_or_a_file(folder: Path, tmp_path: Path) -> None:
    stick = tmp_path / "stick"
    stick.mkdir()
    (stick / "tiny.onnx").write_bytes(CONTENT)
    for source in (stick, stick / "tiny.onnx"):
        fetch(folder, source)
        assert (folder / "tiny.onnx").read_bytes() == CONTENT
        (folder / "tiny.onnx").unlink()
    (stick / "tiny.onnx").write_bytes(ALTERED)
    with pytest.raises(ModelError, match="not the published file"):
        fetch(folder, stick)
    with pytest.raises(ModelError, match="no such file; --from is a file, the folder that has it"):
        fetch(folder, tmp_path / "nowhere")
    with pytest.raises(ModelError, match="is not to be had from a network; give the file with --from"):
        fetch(folder, "")
    assert [path.name for path in folder.iterdir()] == ["tiny.toml"]


def test_an_altered_file_is_replaced_and_a_right_one_is_left(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "tiny.onnx").write_bytes(CONTENT)
    (folder / "tiny.onnx").write_bytes(ALTERED)
    fetch(folder, tmp_path)
    assert (folder / "tiny.onnx").read_bytes() == CONTENT
    found = CliRunner().invoke(app, ["fetch", "tiny", "--folder", str(folder)])
    assert found.exit_code == 0 and "is there already, as published" in found.output


def test_the_licence_is_shown(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "tiny.onnx").write_bytes(CONTENT)
    found = CliRunner().invoke(app, ["fetch", "tiny", "--from", str(tmp_path), "--folder", str(folder)])
    assert found.exit_code == 0 and "licence CC0" in found.output and "sha256 is right" in found.output


def test_a_folder_that_cannot_be_used(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "tiny.onnx").write_bytes(CONTENT)
    (tmp_path / "file").write_text("")
    with pytest.raises(TerrafixError) as error:
        fetch_all(["xfeat"], str(tmp_path / "tiny.onnx"), str(tmp_path / "file" / "models"))
    assert isinstance(error.value, OutputError) and "the model was not fetched" in str(error.value)
    with pytest.raises(ModelError, match="no model is called 'superglue'; known: "):
        fetch_all(["superglue"], "", str(folder))
    if os.geteuid() != 0:  # root may read everything
        folder.chmod(0o000)
        with pytest.raises(ModelError, match="cannot be read"):
            fetch(folder, tmp_path)
        folder.chmod(0o755)


def test_a_full_disk_is_told_and_what_came_is_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with serving(ranged) as server, pytest.raises(OutputError, match=r"tiny\.onnx: No space left on device; the model"):
        fetch(folder, f"{server.url}/tiny.onnx")
    assert not (folder / "tiny.onnx").exists() and (folder / "tiny.onnx.part").stat().st_size == len(CONTENT)


def test_two_at_once_do_not_write_into_each_other(folder: Path) -> None:
    other: list[str] = []

    def answer(asked: Asked) -> Reply:
        if not other:
            with pytest.raises(ModelError, match="another terrafix is fetching this model") as error:
                fetch(folder, "http://127.0.0.1:1/tiny.onnx")
            other.append(str(error.value))
        return ranged(asked)

    with serving(answer) as server:
        fetch(folder, f"{server.url}/tiny.onnx")
    assert other and (folder / "tiny.onnx").read_bytes() == CONTENT
