"""`terrafix models fetch`: a complete and verified file, or none."""

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

import tiny_onnx
from map_servers import Reply, Request, serving
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
    """A models folder with the manifest of a model `tiny`, without its file."""
    folder = tmp_path / "models"
    folder.mkdir()
    tiny_onnx.write(folder, tiny_onnx.XFEAT_LIKE, CONTENT).unlink()
    return folder


def fetch(folder: Path, source: object) -> None:
    fetch_all(["tiny"], str(source), str(folder))


def fetched(folder: Path, answer: Callable[[Request], Reply]) -> list[Request]:
    """Fetches the model from a server. -> its requests."""
    with serving(answer) as server:
        fetch(folder, f"{server.url}/tiny.onnx")
    return server.requests


def ranged(request: Request, content: bytes = CONTENT) -> Reply:
    """A server that supports range requests."""
    wanted = request.headers.get("Range", "")
    if not wanted:
        return Reply(body=content)
    start = int(wanted.removeprefix("bytes=").rstrip("-"))
    headers = {"Content-Range": f"bytes {start}-{len(content) - 1}/{len(content)}"}
    return Reply(status=206, body=content[start:], headers=headers)


def test_fetch_downloads_a_complete_file(folder: Path) -> None:
    fetched(folder, ranged)
    assert (folder / "tiny.onnx").read_bytes() == CONTENT
    assert sorted(path.name for path in folder.iterdir()) == ["tiny.onnx", "tiny.toml"]


def test_fetch_resumes_after_a_lost_connection(folder: Path) -> None:
    def cut(request: Request) -> Reply:
        reply = ranged(request)
        reply.content_length = len(reply.body)
        reply.body = reply.body[:9000]
        return reply

    ranges = [request.headers.get("Range", "") for request in fetched(folder, cut)]
    assert (folder / "tiny.onnx").read_bytes() == CONTENT
    assert ranges[:3] == ["", "bytes=9000-", "bytes=18000-"]


def test_a_later_fetch_resumes_and_restarts_when_the_partial_file_does_not_match(folder: Path) -> None:
    part = folder / "tiny.onnx.part"
    for begun, requests in ((CONTENT[:500], 1), (b"another file", 2)):
        (folder / "tiny.onnx").unlink(missing_ok=True)
        part.write_bytes(begun)
        sent = fetched(folder, ranged)
        assert sent[0].headers["Range"] == f"bytes={len(begun)}-" and len(sent) == requests
        assert (folder / "tiny.onnx").read_bytes() == CONTENT and not part.exists()


def test_fetch_restarts_on_a_server_without_range_requests(folder: Path) -> None:
    (folder / "tiny.onnx.part").write_bytes(b"x" * 500)
    fetched(folder, lambda _: Reply(body=CONTENT))
    assert (folder / "tiny.onnx").read_bytes() == CONTENT


def test_fetch_retries_a_server_that_recovers(folder: Path) -> None:
    replies = iter([Reply(status=503), Reply(status=429)])
    fetched(folder, lambda request: next(replies, None) or ranged(request))
    assert (folder / "tiny.onnx").read_bytes() == CONTENT


def always_cut(_: Request) -> Reply:
    return Reply(body=CONTENT[:100], content_length=len(CONTENT))


ALTERED = CONTENT[:-1] + b"?"


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (lambda _: Reply(status=404), "the server refuses (status 404); check the address"),
        (lambda _: Reply(status=500), "the server returned status 500, 0.0 of 0.1 MB are here; run it again"),
        (always_cut, "the answer was cut off, 0.0 of 0.1 MB are here; run it again to go on"),
        (lambda _: Reply(body=b"<html>no</html>"), "has 15 bytes, the published file"),
        (lambda _: Reply(body=CONTENT + b"more"), "the published file"),
        (lambda _: Reply(body=ALTERED), "not the published file (sha256"),
    ],
)
def test_a_failed_fetch_is_reported_and_leaves_no_model_file(
    folder: Path, answer: Callable[[Request], Reply], reason: str
) -> None:
    with pytest.raises(ModelError) as error:
        fetched(folder, answer)
    assert reason in str(error.value) and "\n" not in str(error.value)
    assert not (folder / "tiny.onnx").exists()


def test_fetch_without_network_is_reported(folder: Path) -> None:
    with serving(ranged) as server:
        url = server.url
    with pytest.raises(ModelError, match=r"no connection, 0\.0 of .* or give a file with --from"):
        fetch(folder, f"{url}/tiny.onnx")
    assert [path.name for path in folder.iterdir()] == ["tiny.toml"]


def test_fetch_copies_from_a_folder_or_a_file(folder: Path, tmp_path: Path) -> None:
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


def test_fetch_replaces_an_altered_file_and_keeps_a_correct_one(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "tiny.onnx").write_bytes(CONTENT)
    (folder / "tiny.onnx").write_bytes(ALTERED)
    fetch(folder, tmp_path)
    assert (folder / "tiny.onnx").read_bytes() == CONTENT
    found = CliRunner().invoke(app, ["fetch", "tiny", "--folder", str(folder)])
    assert found.exit_code == 0 and "is there already, as published" in found.output


def test_fetch_shows_the_licence(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "tiny.onnx").write_bytes(CONTENT)
    found = CliRunner().invoke(app, ["fetch", "tiny", "--from", str(tmp_path), "--folder", str(folder)])
    assert found.exit_code == 0 and "licence CC0" in found.output and "sha256 is right" in found.output


def test_fetch_reports_an_unusable_models_folder(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "tiny.onnx").write_bytes(CONTENT)
    (tmp_path / "file").write_text("")
    with pytest.raises(TerrafixError) as error:
        fetch_all(["xfeat"], str(tmp_path / "tiny.onnx"), str(tmp_path / "file" / "models"))
    assert isinstance(error.value, OutputError) and "the model was not fetched" in str(error.value)
    with pytest.raises(ModelError, match="no model is called 'superglue'; known: "):
        fetch_all(["superglue"], "", str(folder))
    if os.geteuid() != 0:  # root ignores permissions
        folder.chmod(0o000)
        with pytest.raises(ModelError, match="cannot be read"):
            fetch(folder, tmp_path)
        folder.chmod(0o755)


def test_a_full_disk_is_reported_and_the_partial_file_remains(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match=r"tiny\.onnx: No space left on device; the model"):
        fetched(folder, ranged)
    assert not (folder / "tiny.onnx").exists() and (folder / "tiny.onnx.part").stat().st_size == len(CONTENT)


def test_two_concurrent_fetches_use_separate_files(folder: Path) -> None:
    other: list[str] = []

    def answer(request: Request) -> Reply:
        if not other:
            with pytest.raises(ModelError, match="another terrafix is fetching this model") as error:
                fetch(folder, "http://127.0.0.1:1/tiny.onnx")
            other.append(str(error.value))
        return ranged(request)

    fetched(folder, answer)
    assert other and (folder / "tiny.onnx").read_bytes() == CONTENT
