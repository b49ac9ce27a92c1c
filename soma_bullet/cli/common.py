"""What every command does alike: errors are one message and an exit status."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TypeVar

Options = TypeVar("Options")
WIDTH = 110  # [characters] of what is printed where there is no terminal; the tables need this much


def run_command(command: Callable[[Options], int], options: Options) -> int:
    """The exit status of a command; what this package raises is printed, and an interruption is 130."""
    from soma_bullet.errors import SomaBulletError

    try:
        return command(options)
    except SomaBulletError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_status
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return 130
