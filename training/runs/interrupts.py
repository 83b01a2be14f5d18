"""Ctrl-C during a training: it waits until a step is done."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def holding_interrupts() -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C wait until a step is done; half a step could not be saved. A second Ctrl-C does not wait.

    Where somebody else listens for it (or this is not the main thread, to which signals come), it is left to them.

    Returns:
        Says whether it was pressed.
    """
    pressed = False

    def note(_signal: int, _frame: FrameType | None) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    mine = threading.current_thread() is threading.main_thread()
    if not mine or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield lambda: False
        return
    signal.signal(signal.SIGINT, note)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if pressed:  # after the last step
        raise KeyboardInterrupt
