"""The command line: what is printed, exit codes. The commands are in `lfd.commands`."""

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from lfd.commands import (
    comparisons,
    console,
    corrections,
    dagger,
    demonstrations,
    experts,
    interaction,
    learning,
    looking,
    reward,
    rewards,
)
from lfd.commands.options import Commands, Result
from lfd.core.errors import InputError, LfdError
from lfd.worlds.rendering import check_wish

PIPELINE = """\
the way from a demonstration to a policy:
  lfd record datasets/lift_panda.toml --out outputs/recordings     scripted demonstrations as MCAP files
  lfd convert outputs/recordings --out outputs/dataset             a LeRobot v3 dataset, verified
  lfd train policies/bc_mlp.toml --dataset outputs/dataset --out outputs/policy
  lfd eval outputs/policy --out outputs/run                        success rate with its interval
  lfd replay outputs/run --save rollout.rrd                        look at it in Rerun
or all of it: lfd demo
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code: 0 success, 2 the user's mistake, 1 anything else."""
    arguments = _parser().parse_args(argv)
    command: Callable[[argparse.Namespace], Result] = arguments.command
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    try:
        if command is not looking.run_doctor:
            check_wish()
        with _only_json_on_stdout(arguments.json) as out:
            result = command(arguments)
            failed = result.pop("failed", False)
            if arguments.json:
                out.write(json.dumps(result) + "\n")
            else:
                _show(arguments.name, result)
    except InputError as error:
        print(f"lfd {arguments.name}: {error}", file=sys.stderr)
        return 2
    except LfdError as error:
        print(f"lfd {arguments.name}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        kept = {
            "record": "finished episodes are kept",
            "plan": "finished episodes are kept",
            "demo": "finished stages are kept",
            "train": "--resume goes on from the last checkpoint, if there was one",
            "sweep": "finished policies are kept",
            "compare": "answers so far are kept, --resume goes on",
            "dagger": "finished rounds are kept, --resume goes on",
            "recover": "what was recovered so far is kept",
        }
        print(
            f"\nlfd {arguments.name}: interrupted; {kept.get(arguments.name, 'nothing was written')}", file=sys.stderr
        )
        return 1
    return 1 if failed else 0


@contextmanager
def _only_json_on_stdout(wanted: bool) -> Iterator[Any]:
    """With --json, whatever the libraries print goes to standard error, also from C."""
    if not wanted:
        yield sys.stdout
        return
    sys.stdout.flush()
    real = os.dup(1)
    os.dup2(2, 1)
    try:
        with os.fdopen(os.dup(real), "w") as out:
            yield out
    finally:
        sys.stdout.flush()
        os.dup2(real, 1)
        os.close(real)


def _show(title: str, result: Result) -> None:
    from lfd.terminal import print_table

    if list(result) == ["lines"]:
        print(*result["lines"], sep="\n")
        return
    rows = {}
    for key, value in result.items():
        if isinstance(value, dict) and "meaning" in value:
            value = f"{value['value']}\n{value['meaning']}"
        elif isinstance(value, dict):
            value = ", ".join(f"{k} {v}" for k, v in value.items())
        elif isinstance(value, float):
            value = f"{value:.4g}"
        elif isinstance(value, (list, tuple)):
            value = ", ".join(f"{v:.3f}" if isinstance(v, float) else str(v) for v in value)
        rows[key] = value
    print_table(f"lfd {title}", rows)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="lfd",
        description="Robot learning from demonstration: record, convert, train, run and replay.",
        epilog=PIPELINE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = Commands(parser)
    for group in (
        demonstrations,
        experts,
        learning,
        dagger,
        rewards,
        comparisons,
        corrections,
        reward,
        interaction,
        console,
        looking,
    ):
        group.add(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())
