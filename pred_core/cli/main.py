"""`pred COMMAND ...`: one module a command, imported only when it is asked for."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence
from types import ModuleType

from pred_core.errors import PredError, nearest

COMMANDS: tuple[str, ...] = ("info", "convert", "track", "identify", "train", "diagnose", "evaluate", "plan", "plant")
INTERRUPTED = 130  # the shell's code for SIGINT
BAD_INPUT = 2
_INTERRUPTED = "run the same command again to go on where it stopped"
_INTERRUPTED_IN = {
    "identify": "run the same command again: the search goes on where it stopped, the refinement starts again",
    "train": "run the same command again with --resume to go on from the last checkpoint",
    "info": "nothing was changed",
}  # commands that do not go on exactly where they stopped


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command. Returns the exit code: 0 done, 2 bad input (one line on stderr), 130 interrupted."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    name = next((a for a in arguments if not a.startswith("-")), None)
    try:
        if name is not None and name not in COMMANDS:
            raise PredError(f"unknown command '{name}'", next_step=nearest(name, COMMANDS))
        chosen = COMMANDS if name is None else (name,)
        args = _parser({c: _module(c) for c in chosen}).parse_args(arguments)
        return int(args.run(args))
    except PredError as error:
        print(f"pred: {error}", file=sys.stderr)
        return BAD_INPUT
    except OSError as error:
        where = error.filename or "a file"
        print(f"pred: {where}: {error.strerror or error}. Give a path that can be read and written.", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print(f"pred: interrupted; {_INTERRUPTED_IN.get(name or '', _INTERRUPTED)}", file=sys.stderr)
        return INTERRUPTED


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"pred_core.cli.{name}_command")


def _parser(modules: dict[str, ModuleType]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="pred", description="Track, predict, diagnose and drive soft objects.")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, module in modules.items():
        sub = subparsers.add_parser(name, help=module.HELP, description=module.HELP)
        module.configure(sub)
        sub.set_defaults(run=module.run)
    return parser


if __name__ == "__main__":
    sys.exit(main())
