"""Who stops a command while kernels are compiled is heard, too."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from topomerge.cli.console import exit_on_signals

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
WAIT = 5.0  # s


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """The process has its own again afterwards."""
    own = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)}
    exit_on_signals()
    yield
    signal.setitimer(signal.ITIMER_REAL, 0)
    for number, handler in own.items():
        signal.signal(number, handler)


def as_compiler(file: str, name: str = "call") -> Callable[[Callable[[], Any]], list[str]]:
    """A function of a file that calls another one and swallows what it raises, as a callback from C does."""
    space: dict[str, Any] = {}
    source = (
        f"def {name}(f):\n    try:\n        f()\n    except BaseException as e:\n        return [type(e).__name__]\n    return []"
    )
    exec(compile(source, file, "exec"), space)
    call: Callable[[Callable[[], Any]], list[str]] = space[name]
    return call


DEAF = ((os.sep + os.path.join("lib", "llvmlite", "binding", "ffi.py"), "call"), ("<frozen importlib._bootstrap>", "cb"))


@pytest.mark.parametrize(("file", "name"), DEAF)
@pytest.mark.parametrize(("number", "error"), [(signal.SIGTERM, SystemExit), (signal.SIGINT, KeyboardInterrupt)])
def test_a_signal_where_it_would_be_lost_is_raised_afterwards(
    number: int, error: type[BaseException], file: str, name: str
) -> None:
    call = as_compiler(file, name)

    def compile_and_go_on() -> None:
        assert call(lambda: os.kill(os.getpid(), number)) == []
        time.sleep(WAIT)

    with pytest.raises(error) as raised:
        compile_and_go_on()
    assert not isinstance(raised.value, SystemExit) or raised.value.code == 143


@pytest.mark.parametrize(("number", "error"), [(signal.SIGTERM, SystemExit), (signal.SIGINT, KeyboardInterrupt)])
def test_elsewhere_it_is_raised_at_once(number: int, error: type[BaseException]) -> None:
    with pytest.raises(error):
        os.kill(os.getpid(), number)
    assert as_compiler("somewhere.py")(lambda: os.kill(os.getpid(), number)) == [error.__name__]
