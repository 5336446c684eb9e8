"""Changes the program in small ways, one at a time, and tells which changes no test notices.

    python tests/bench/mutants.py sitl/filters.py
    python tests/bench/mutants.py --sample 50 --seed 1

Nothing is written: tests are collected once per file, then a forked copy of the process takes over the changed code and
runs them until one fails. The laws run uncompiled. A survivor is a missing test, or a change that changes nothing
(docs/architecture.md, Tests); which of the two, people must tell. Exit status 0 whatever survives.
"""

from __future__ import annotations

import argparse
import ast
import copy
import inspect
import os
import random
import re
import resource
import sys
import tempfile
import time
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ["NUMBA_DISABLE_JIT"] = "1"
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import pytest  # noqa: E402
from hypothesis import Phase, settings  # noqa: E402

PARAMS = ("tests/bridge/test_param_protocol.py", "tests/bridge/test_param_client.py")
TESTS: dict[str, tuple[str, ...]] = {
    "sitl/rate_control.py": ("tests/sitl/test_rate_control.py",),
    "sitl/attitude_control.py": ("tests/sitl/test_attitude_control.py",),
    "sitl/filters.py": ("tests/sitl/test_filters.py", "tests/sitl/test_rate_control.py"),
    "sitl/actuators.py": ("tests/sitl/test_actuators.py",),
    "sitl/froude.py": ("tests/sitl/test_froude.py",),
    "bridge/param_protocol.py": PARAMS,
    "bridge/param_operation.py": ("tests/bridge/test_param_operation.py", *PARAMS),
    "scenarios/metrics.py": ("tests/scenarios/test_metrics.py",),
    "scenarios/limits.py": ("tests/scenarios/test_limits.py", "tests/scenarios/test_score.py"),
    "scenarios/batch_metrics.py": (
        "tests/scenarios/test_batch_metrics.py",
        "tests/scenarios/test_monte_carlo.py::TestLaneMetrics",
    ),
}
"""The tests that are to notice what is changed in a file."""

_COMPARED: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_OPERATED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitOr: ast.BitAnd,
    ast.BitAnd: ast.BitOr,
}
_CALLED = {"min": "max", "max": "min", "sin": "cos", "cos": "sin", "any": "all", "all": "any"}
_KILLED, _SURVIVED = 1, 0


def changes(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """What to put in the place of a node, each with its name."""

    def altered(**fields: Any) -> ast.AST:
        other = copy.copy(node)
        for name, value in fields.items():
            setattr(other, name, value)
        return other

    def negated(test: ast.expr) -> ast.expr:
        return ast.UnaryOp(ast.Not(), test)

    match node:
        case ast.Compare(ops=[first, *rest]):
            for op in _COMPARED[type(first)]:
                yield op.__name__, altered(ops=[op(), *rest])
            for op in _COMPARED[type(rest[-1])] if rest else ():
                yield f"last {op.__name__}", altered(ops=[first, *rest[:-1], op()])
        case ast.BinOp(op=op) if type(op) in _OPERATED:
            yield _OPERATED[type(op)].__name__, altered(op=_OPERATED[type(op)]())
        case ast.AugAssign(op=op):
            yield _OPERATED[type(op)].__name__, altered(op=_OPERATED[type(op)]())
            yield "dropped", ast.Pass()
        case ast.UnaryOp(op=ast.USub() | ast.Not(), operand=operand):
            yield "sign or not gone", operand
        case ast.BoolOp(op=op):
            yield "and/or", altered(op=ast.Or() if isinstance(op, ast.And) else ast.And())
        case ast.Constant(value=bool(value)):
            yield str(not value), altered(value=not value)
        case ast.Constant(value=int(value)):
            yield str(value + 1), altered(value=value + 1)
        case ast.Constant(value=float(value)):
            yield str(2.0 * value or 1.0), altered(value=2.0 * value or 1.0)
        case ast.Call(func=ast.Name(id=name)) if name in _CALLED:
            yield _CALLED[name], altered(func=ast.Name(_CALLED[name], ast.Load()))
        case ast.Call(func=ast.Attribute(attr=name) as called) if name in _CALLED:
            function = copy.copy(called)
            function.attr = _CALLED[name]
            yield _CALLED[name], altered(func=function)
        case ast.Call(func=ast.Name(id="select"), args=[test, yes, no]):
            yield "swapped", altered(args=[test, no, yes])
        case ast.If(test=test) | ast.IfExp(test=test) | ast.While(test=test) if not isinstance(test, ast.Compare):
            yield "negated", altered(test=negated(test))
        case ast.Return(value=ast.expr() as value) if not isinstance(value, ast.Constant) or value.value is not None:
            yield "None", altered(value=ast.Constant(None))
        case ast.Expr(value=value) if not isinstance(value, ast.Constant):
            yield "dropped", ast.Pass()
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript(), *_]) | ast.Raise() | ast.Delete():
            yield "dropped", ast.Pass()
        case ast.Continue():
            yield "break", ast.Break()
        case ast.Break():
            yield "continue", ast.Continue()


_Path = tuple[tuple[str, int | None], ...]
_NOT_CHANGED = (ast.JoinedStr, ast.Assert)
"""Texts for people, and what tells a type checker that a value is there."""


def places(node: ast.AST, at: _Path = ()) -> Iterator[tuple[_Path, ast.AST]]:
    """Every node whose change would change what the program does, with the way to it."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for n, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if isinstance(child, ast.AST) and not isinstance(child, _NOT_CHANGED):
                yield (*at, (name, n)), child
                yield from places(child, (*at, (name, n)))


def mutants(source: str) -> Iterator[tuple[str, ast.Module]]:
    """Every changed program with what was changed."""
    tree = ast.parse(source)
    for at, node in places(tree):
        for what, new in changes(node):
            changed = copy.deepcopy(tree)
            parent: Any = changed
            for name, n in at[:-1]:
                parent = getattr(parent, name) if n is None else getattr(parent, name)[n]
            name, n = at[-1]
            if n is None:
                setattr(parent, name, ast.copy_location(new, node))
            else:
                getattr(parent, name)[n] = ast.copy_location(new, node)
            shown = ast.unparse(node).split("\n")[0]
            yield f"{node.lineno}:{node.col_offset + 1}: {shown}  ->  {what}", ast.fix_missing_locations(changed)


def take_over(name: str, file: Path, tree: ast.Module) -> None:
    """Give the module of this process, and all who imported from it, the code and the values of a changed one."""
    module = sys.modules[name]
    new: dict[str, Any] = {"__name__": name, "__file__": str(file)}
    exec(compile(tree, str(file), "exec"), new)
    for key, value in new.items():
        old = vars(module).get(key)
        if key.startswith("__") or old is value:
            continue
        if isinstance(value, types.FunctionType):
            _take_code(old, value)
        elif isinstance(value, type) and not _is_enum(value):
            _take_class(old, value)
        elif repr(old) != repr(value) or (isinstance(value, type) and repr(list(old)) != repr(list(value))):
            for other in list(sys.modules.values()):
                if vars(other).get(key) is old:
                    setattr(other, key, value)


def _is_enum(value: type) -> bool:
    return hasattr(value, "__members__")


def _take_code(old: Any, new: Any) -> None:
    old, new = inspect.unwrap(old), inspect.unwrap(new)
    if old.__code__ != new.__code__:
        old.__code__ = new.__code__
    for name in ("__defaults__", "__kwdefaults__"):
        if repr(getattr(old, name)) != repr(getattr(new, name)):  # an enum's member is another in the copy
            setattr(old, name, getattr(new, name))


def _take_class(old: type, new: type) -> None:
    for key, value in vars(new).items():
        mine = vars(old).get(key)
        if isinstance(value, types.FunctionType):
            _take_code(mine, value)
        elif isinstance(value, property):
            _take_code(mine.fget, value.fget)
        elif isinstance(value, (bool, int, float, str, tuple, frozenset)) and mine != value and key != "__module__":
            setattr(old, key, value)


class Hunt:
    """Collects the tests of one file, then lets every mutant run them.

    Args:
        file: the file to change. limit: most mutants, 0 for all. seed: of the choice among them. only: a pattern that a
            mutant's line must match.
    """

    def __init__(self, file: str, limit: int, seed: int, only: str) -> None:
        self.file, self.limit, self.seed, self.only = file, limit, seed, only
        self.survivors: list[str] = []
        self.tried = 0

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        name = self.file.removesuffix(".py").replace("/", ".")
        __import__(name)
        began = time.process_time(), time.perf_counter()
        as_it_is = ast.parse((ROOT / self.file).read_text())
        items, failing = self._sound(session, lambda: take_over(name, ROOT / self.file, as_it_is))
        cpu_s = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        print(f"\n{self.file}: {len(items)} tests pass in {time.perf_counter() - began[1]:.1f} s", flush=True)
        for nodeid in failing:
            print(f"  left out, fails as it is without the compiler: {nodeid}")
        found = [
            one for one in mutants((ROOT / self.file).read_text()) if re.search(self.only, f"{self.file}:{one[0]}")
        ]
        if 0 < self.limit < len(found):
            found = sorted(random.Random(self.seed).sample(found, self.limit), key=found.index)
        for what, tree in found:
            status = self._forked(
                lambda tree=tree: take_over(name, ROOT / self.file, tree), items, round(5.0 + 4.0 * cpu_s)
            )
            self.tried += 1
            if status == _SURVIVED:
                self.survivors.append(what)
                print(f"  survived {self.file}:{what}", flush=True)
        return True

    def _sound(self, session: pytest.Session, prepare: Callable[[], None]) -> tuple[list[pytest.Item], list[str]]:
        """The tests that pass as it is, and the others; found out by leaving out whatever fails."""
        items, failing = list(session.items), []
        with tempfile.NamedTemporaryFile("r") as told:
            while self._forked(prepare, items, 600, Path(told.name)) != _SURVIVED:
                nodeid = Path(told.name).read_text()
                failing.append(nodeid)
                items = [item for item in items if item.nodeid != nodeid]
        return items, failing

    def _forked(
        self, prepare: Callable[[], None], items: list[pytest.Item], cpu_s: int, told: Path | None = None
    ) -> int:
        """Run tests in a copy of this process; not 0 if one fails, or if it takes so long that it never ends."""
        pid = os.fork()
        if pid:
            return os.waitpid(pid, 0)[1]
        status = _KILLED
        try:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            os.dup2(1, 2)
            resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s))
            prepare()
            for item, after in zip(items, [*items[1:], None], strict=True):
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
                if item.session.testsfailed:
                    if told is not None:
                        told.write_text(item.nodeid)
                    break
            else:
                status = _SURVIVED
        finally:
            os._exit(status)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "file", nargs="*", choices=[[], *TESTS], default=[], metavar="FILE", help="all if none is given"
    )
    parser.add_argument("--sample", type=int, default=0, metavar="N", help="at most N mutants of each file; 0: all")
    parser.add_argument("--seed", type=int, default=1, help="of the choice")
    parser.add_argument("--only", default="", metavar="REGEX", help="mutants whose line, as printed, it matches")
    args = parser.parse_args()
    os.chdir(ROOT)
    # the same examples for every mutant, none kept, and a failing one is not made smaller
    settings.register_profile("mutants", database=None, derandomize=True, phases=(Phase.explicit, Phase.generate))
    settings.load_profile("mutants")
    for file in args.file or TESTS:
        began = time.perf_counter()
        pid = os.fork()  # every file is imported anew
        if pid:
            os.waitpid(pid, 0)
            continue
        hunt = Hunt(file, args.sample, args.seed, args.only)
        with tempfile.TemporaryDirectory() as folder:
            options = ["-o", "addopts=--import-mode=importlib", "-p", "no:cacheprovider", "-p", "no:terminal", "-s"]
            options += ["--assert=plain", f"--basetemp={folder}/t"]
            pytest.main([*options, *TESTS[file]], plugins=[hunt])
        killed = hunt.tried - len(hunt.survivors)
        print(f"{file}: {hunt.tried} mutants, {killed} killed, {len(hunt.survivors)} survived", end="")
        print(f" ({time.perf_counter() - began:.0f} s)", flush=True)
        os._exit(0)


if __name__ == "__main__":
    main()
