"""Completion in real shells: keys are typed into them, and what stands on the line is read back."""

from __future__ import annotations

import os
import pty
import re
import select
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from topomerge.cli.completion import SHELLS, build_script
from topomerge.cli.main import COMMANDS


def typed(words: list[str], folder: Path, keys: str, requested: str, setup: str) -> str:
    """What a shell shows after keys were typed into it; waits until it shows what is wanted."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(folder)
        os.execvpe(words[0], words, {"PATH": os.environ["PATH"], "TERM": "dumb", "PS1": "> ", "HOME": str(folder)})
    shown = ""
    try:
        for text, until in ((setup + "; echo set''up\n", "setup"), (keys, requested.strip())):
            os.write(terminal, text.encode())
            end, start = time.monotonic() + 30, len(shown)
            while until not in shown[start:] and time.monotonic() < end:
                if select.select([terminal], [], [], 0.2)[0]:
                    shown += re.sub("[\x00-\x09\x0b-\x1f]", "", os.read(terminal, 4096).decode(errors="replace"))
        return shown[start:]
    finally:
        os.kill(pid, 9)
        os.waitpid(pid, 0)
        os.close(terminal)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the scripts, scans, maps and folders."""
    for shell in SHELLS:
        (tmp_path / f"complete.{shell}").write_text(build_script(shell, COMMANDS))
    for name in ("a scan.ply", "b.tmap", "pairs/c.tmap", "two words/d.tmap"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    return tmp_path


CASES = [
    ("topomerge ext\t", "topomerge extract "),
    ("topomerge --ver\t", "topomerge --version "),
    ("topomerge extract --preset th\t", "topomerge extract --preset thesis "),
    ("topomerge extract --unit=f\t", "topomerge extract --unit=ft "),
    ("topomerge extract a\t", "topomerge extract a\\ scan.ply "),
    ("topomerge extract --ceiling a\t", "topomerge extract --ceiling a\\ scan.ply "),
    ("topomerge info two\\ words/d\t", "topomerge info two\\ words/d.tmap "),
    ("topomerge simulate -o pa\t", "topomerge simulate -o pairs/"),
    ("topomerge completion fi\t", "topomerge completion fish "),
    ("topomerge merge --fo\t", "topomerge merge --force "),
    ("topomerge merge b.tmap pairs/c\t", "topomerge merge b.tmap pairs/c.tmap "),
    ("topomerge merge b.tmap -o x --scale=free pairs/c\t", "topomerge merge b.tmap -o x --scale=free pairs/c.tmap "),
    ("topomerge atlas ad\t", "topomerge atlas add "),
    ("topomerge atlas add pa\t", "topomerge atlas add pairs/"),
    ("topomerge atlas add --scale free pairs b.tmap pairs/c\t", "topomerge atlas add --scale free pairs b.tmap pairs/c.tmap "),
]


@pytest.mark.parametrize(("keys", "requested"), CASES)
def test_bash_completes(folder: Path, keys: str, requested: str) -> None:
    if shutil.which("bash") is None:
        pytest.skip("no bash")
    shown = typed(["bash", "--norc", "--noprofile", "-i"], folder, keys, requested, "source ./complete.bash")
    assert requested in shown


@pytest.mark.parametrize(("keys", "requested"), CASES)
def test_zsh_completes(folder: Path, keys: str, requested: str) -> None:
    if shutil.which("zsh") is None:
        pytest.skip("no zsh")
    shown = typed(["zsh", "-f", "-i"], folder, keys, requested.strip(), "unsetopt prompt_sp; source ./complete.zsh")
    assert " ".join(requested.split()) in " ".join(shown.split())


@pytest.mark.parametrize(("keys", "requested"), CASES)
def test_fish_completes(folder: Path, keys: str, requested: str) -> None:
    if shutil.which("fish") is None:
        pytest.skip("no fish")
    line = keys.split("\t")[0]
    words = ["fish", "--no-config", "-c", "source complete.fish; complete -C $argv[1]", line]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=60, check=True)
    offered = [text.split("\t")[0] for text in done.stdout.splitlines()]
    completed = requested.replace("\\", "").strip().rstrip("/")
    assert any(completed.endswith(word.replace("\\", "").rstrip("/")) for word in offered if word.strip("/"))


@pytest.mark.parametrize("shell", SHELLS)
def test_every_command_and_option_is_in_the_script(shell: str) -> None:
    text = build_script(shell, COMMANDS)
    for command in COMMANDS:
        assert command.name in text
        for flags, _ in command.arguments:
            for flag in flags:
                assert flag.lstrip("-") in text or not flag.startswith("-")
