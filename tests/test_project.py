"""Rules that the tree keeps: import contracts, file sizes, docstrings, nothing of the machine it was written on."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGES = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
GENERATED = "bridge/dialect/froude_messages.py"
MODULES = sorted(
    name
    for package in PACKAGES
    for path in (ROOT / package).rglob("*.py")
    if (name := path.relative_to(ROOT).as_posix()) != GENERATED
)
MOST_LINES = 400
HEAVY = {"numpy", "scipy", "numba", "control", "pymavlink", "pyarrow", "rerun", "rich"}


def tracked() -> list[Path]:
    """Every file of the project as git sees it, new ones too; those that a run or a cache made are ignored."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    try:
        found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"not a working copy of git: {error}")
    return sorted(path for name in found.stdout.split("\0") if name and (path := ROOT / name).is_file())


def run(*command: str, cwd: Path = ROOT) -> str:
    """Output of a Python program of this environment; it must succeed."""
    done = subprocess.run([sys.executable, *command], cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_import_contracts() -> None:
    printed = run(
        "-c",
        "from importlinter.cli import lint_imports; raise SystemExit(lint_imports(no_cache=True, no_logo=True))",
    )
    kept = len(PROJECT["tool"]["importlinter"]["contracts"])
    assert f"Contracts: {kept} kept, 0 broken" in printed


@pytest.mark.parametrize("name", MODULES)
def test_a_module_says_what_it_is_for_and_is_not_too_long(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    assert ast.get_docstring(ast.parse(text)), "it has no docstring"
    assert text.count("\n") <= MOST_LINES, "split it"


def test_nothing_names_a_machine() -> None:
    # In pieces, so that this file does not find itself.
    places, hosts = ("work", "tmp", "root", "Users", "home(?!/me/)"), ("pypi", "pythonhosted", "anaconda")
    traces = re.compile(
        rf"(?<![\w.}}])/(?:{'|'.join(places)})/\w\w|\b(?:{'|'.join(hosts)})\.\w+\b|index[-_]url|\bfile://"
    )
    found = []
    for path in tracked():
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue  # a recording or a picture
        found += [f"{path.relative_to(ROOT)}: {match.group()}" for match in traces.finditer(text)]
    assert not found


# What turns bytes into code, or a text into a command. Pools of processes (and Dask, where asked for) unpickle what
# their own parent sends, which is no file and no peer: README, "Security: who could do what".
CODE_MODULES = {"pickle", "_pickle", "cPickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "pty", "code"}
CODE_CALLS = {"eval", "exec", "compile", "__import__", "breakpoint"}
CODE_ATTRIBUTES = {
    *(
        "os." + name
        for name in ("system", "popen", "execl", "execle", "execlp", "execv", "execve", "execvp", "execvpe")
    ),
    *("os." + name for name in ("spawnl", "spawnle", "spawnlp", "spawnv", "spawnve", "spawnvp", "startfile")),
    *("subprocess." + name for name in ("getoutput", "getstatusoutput")),
    *("asyncio." + name for name in ("create_subprocess_shell",)),
    *("pandas." + name for name in ("read_pickle", "eval")),
    *("yaml." + name for name in ("load", "unsafe_load", "full_load")),
    *("runpy." + name for name in ("run_path", "run_module")),
}
CODE_OPTIONS = {"shell", "allow_pickle"}


def ways_into_code(text: str) -> list[str]:
    """Where a module's source could run what somebody else wrote, a word each."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)]
        else:
            names = []
        found += [name for name in names if name.partition(".")[0] in CODE_MODULES or name in CODE_ATTRIBUTES]
        if isinstance(node, ast.Attribute) and ast.unparse(node) in CODE_ATTRIBUTES:
            found.append(ast.unparse(node))
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called in CODE_CALLS:
                found.append(f"{called}()")
            if called == "importlib.import_module" and not all(isinstance(word, ast.Constant) for word in node.args):
                found.append("importlib.import_module() of a name that is made up")
            options = [one for one in node.keywords if one.arg in CODE_OPTIONS]
            found += [
                f"{one.arg}=" for one in options if not (isinstance(one.value, ast.Constant) and not one.value.value)
            ]
    return found


@pytest.mark.parametrize("name", [*MODULES, GENERATED])
def test_nothing_that_a_file_or_a_peer_can_reach_runs_code(name: str) -> None:
    assert not ways_into_code((ROOT / name).read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from marshal import loads",
        "import shelve as s",
        "def f():\n    import pickle",
        "eval(x)",
        "exec('a')",
        "__import__(name)",
        "import os\nos.system(x)",
        "from os import system",
        "import subprocess\nsubprocess.run(x, shell=True)",
        "np.load(path, allow_pickle=yes)",
        "importlib.import_module(name)",
    ],
)
def test_what_runs_code_is_found(source: str) -> None:
    assert ways_into_code(source)


def test_what_runs_no_code_is_not_found() -> None:
    assert not ways_into_code("import re, os\nre.compile('a')\nsubprocess.run(['a'], shell=False)\nos.replace(a, b)")


def test_processes_that_are_started_run_nothing_of_the_working_directory() -> None:
    """`python -m` looks there first, unless told not to."""
    for name in MODULES:
        for node in ast.walk(ast.parse((ROOT / name).read_text(encoding="utf-8"))):
            if isinstance(node, ast.List) and [ast.unparse(word) for word in node.elts[:1]] == ["sys.executable"]:
                assert ast.unparse(node.elts[1]) == "'-P'", f"{name}:{node.lineno}"


def test_constraints_are_exact_and_name_every_dependency() -> None:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(r"[A-Za-z0-9_.-]+==[\w.]+", line) for line in lines)
    pinned = {plain(line.partition("==")[0]) for line in lines}
    extras = PROJECT["project"]["optional-dependencies"].values()
    wanted = [*PROJECT["project"]["dependencies"], *(item for extra in extras for item in extra)]
    assert {plain(re.split(r"[<>=\[]", item)[0]) for item in wanted} <= pinned


def plain(name: str) -> str:
    """A distribution's name as packaging compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def test_help_and_version_load_nothing_heavy() -> None:
    for option in ("--help", "fly --help", "--version"):
        code = (
            "import sys; from scenarios.cli import main\n"
            f"try: status = main({option.split()!r})\n"
            "except SystemExit as end: status = end.code\n"
            "print(); print(*sys.modules); sys.exit(status)"
        )
        loaded = run("-c", code).splitlines()[-1].split()
        assert not {name.partition(".")[0] for name in loaded} & HEAVY, option


def test_the_wheel_holds_every_data_file(tmp_path: Path) -> None:
    builder = pytest.importorskip("hatchling.builders.wheel", reason="hatchling is not installed")
    (wheel,) = builder.WheelBuilder(str(ROOT)).build(directory=str(tmp_path))
    import zipfile

    held = set(zipfile.ZipFile(wheel).namelist())
    data = {path.relative_to(ROOT).as_posix() for path in tracked() if path.relative_to(ROOT).parts[0] in PACKAGES}
    assert data <= held
    assert any(name.endswith(".toml") for name in data)
    assert not {name for name in held if name.startswith(("tests/", "logs/", "docs/"))}


def test_the_program_works_from_any_folder(tmp_path: Path) -> None:
    code = "from scenarios.cli import main; main(['airframes']); main(['model', 'carrier-1'])"
    assert "CARRIER-1" in run("-c", code, cwd=tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_installed_program_is_this_one() -> None:
    try:
        (script,) = metadata.distribution("froude").entry_points.select(group="console_scripts")
    except metadata.PackageNotFoundError:
        pytest.skip("froude is not installed here")
    assert (script.name, script.value) == ("froude", PROJECT["project"]["scripts"]["froude"])
