"""Lists and copies the files that come with Terrafix."""

import shutil
from pathlib import Path

from terrafix.core.errors import OutputError
from terrafix.core.installed_files import installed_files

FOLDERS = ("config", "systemd")
OTHERS = ("docs/jetson.md", "requirements.lock")  # systemd/install.sh needs them


def listed() -> list[Path]:
    """All of them, with their paths. Raises UsageError."""
    root = installed_files()
    found = [path for folder in FOLDERS for path in sorted((root / folder).rglob("*")) if path.is_file()]
    return [*found, *(root / name for name in OTHERS)]


def copied(out: Path) -> list[Path]:
    """Copies all of them into ``out``, and does not replace a file that is another one. Raises OutputError."""
    root, copies = installed_files(), []
    for path in listed():
        target = out / path.relative_to(root)
        try:
            if target.exists() and target.read_bytes() != path.read_bytes():
                raise OutputError(f"{target}: exists, with other content; choose another folder")
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, target)
        except OSError as error:
            raise OutputError(f"{target}: cannot be written ({error.strerror}); choose another folder") from None
        copies.append(target)
    return copies
