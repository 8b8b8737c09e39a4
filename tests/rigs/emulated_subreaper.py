"""The supervisor is the subreaper of its processes, by a prctl(2) that qemu-user refuses (EINVAL) in an emulated root.

The kernel keeps that setting over exec(2): a program of this computer's own processor sets it, and becomes the emulated
Terrafix, in which the call then answers that it has been done. Nothing else is replaced."""

import re
import shutil
import subprocess
from pathlib import Path

PERL = "/usr/bin/perl"  # of perl-base, which every Debian has
SET = "syscall(157, 36, 1, 0, 0, 0) == 0 or die $!; exec @ARGV or die $!"  # prctl(PR_SET_CHILD_SUBREAPER) of x86-64
ANSWER = """
import ctypes
class CDLL(ctypes.CDLL):
    def __getattr__(self, name):
        found = super().__getattr__(name)
        return found if name != "prctl" else lambda option, *rest: 0 if option == 36 else found(option, *rest)
ctypes.CDLL = CDLL
"""


def as_subreaper(root: Path, site: Path) -> list[str]:
    """Prepares the root folder and its site-packages. -> the words in front of a command that is run in it."""
    folder = root / "opt" / "native"
    folder.mkdir(exist_ok=True)
    libraries = re.findall(r"(/\S+) \(0x", subprocess.run(["ldd", PERL], capture_output=True, text=True).stdout)
    for path in (PERL, *libraries):
        shutil.copy(path, folder)
    (loader,) = folder.glob("ld-linux*")
    (site / "emulated_prctl.py").write_text(ANSWER)
    (site / "emulated_prctl.pth").write_text("import emulated_prctl\n")
    return [f"/opt/native/{loader.name}", "--library-path", "/opt/native", "/opt/native/perl", "-e", SET]
