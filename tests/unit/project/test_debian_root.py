"""scripts/debian-root ends with one clear line before it downloads anything, and leaves a finished root as it is."""

import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[3] / "scripts" / "debian-root"


def debian_root(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = ["sh", str(SCRIPT), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["bookworm", "arm64"], "give SUITE ARCH DIR"),
        (["bookworm", "mips"], "the architecture mips is not known here"),
    ],
)
def test_wrong_words_are_one_line(tmp_path: Path, words: list[str], said: str) -> None:
    done = debian_root(*words, *([tmp_path / "root"] if "mips" in words else []))
    assert done.returncode == 1 and said in done.stderr and done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_folder_with_something_else_in_it_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").touch()
    done = debian_root("bookworm", "amd64", tmp_path)
    assert done.returncode == 1 and f"{tmp_path} is no root" in done.stderr and done.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_finished_root_stays_and_other_packages_are_another_root(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc" / "debian-root").write_text("bookworm amd64 python3\n")
    assert debian_root("bookworm", "amd64", tmp_path, "python3").returncode == 0
    assert debian_root("bookworm", "amd64", tmp_path, "gcc").returncode == 1


def test_the_scripts_are_shell() -> None:
    for name in ("arm64", "debian-root", "in-root"):
        assert subprocess.run(["sh", "-n", SCRIPT.with_name(name)], timeout=60, check=False).returncode == 0
