"""The rooms and what each may import; lint, format and types; the README's two commands."""

from __future__ import annotations

import ast
import fnmatch
import functools
import importlib
import importlib.util
import pkgutil
import re
import subprocess
import sys
import tomllib
import typing
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

pytestmark = pytest.mark.house

ROOT = Path(__file__).resolve().parents[1]

MAY_IMPORT = {
    "noise_model": set(),
    "tracker": {"noise_model"},
    "robot_io": set(),
    "calibration": {"noise_model", "tracker"},
    "sim_to_real": {"noise_model", "tracker"},
    "arctrack": {"noise_model", "tracker", "robot_io", "calibration", "sim_to_real"},
    "validation": {"noise_model", "tracker", "robot_io", "calibration", "sim_to_real", "arctrack"},
}
FOLDERS_MAY_IMPORT: dict[str, dict[str, set[str]]] = {
    "noise_model": {
        "compiled": set(),
        "surface": {"compiled"},
        "instrument": {"compiled", "surface"},
        "arc": {"compiled", "surface", "instrument"},
        "interreflection": {"compiled", "surface", "instrument", "arc"},
        "effects": {"compiled", "surface", "instrument", "interreflection"},
        "plan": {"compiled", "surface", "instrument", "arc", "effects"},
    },
    "tracker": {
        "arc": set(),
        "stripe": {"arc"},
        "joint": {"stripe"},
        "seam": set(),
    },
    "robot_io": {
        "protocol": set(),
        "clocks": {"protocol"},
        "link": {"protocol", "clocks"},
        "poses": {"protocol", "link"},
        "ports": {"protocol", "link", "poses"},
    },
    "calibration": {
        "boards": set(),
        "camera": {"boards"},
        "hand_eye_boards": {"boards", "camera"},
        "laser": {"boards", "camera"},
        "gauge": {"camera", "laser"},
        "sensor": set(),
        "arc": set(),
        "check": {"arc"},
    },
    "sim_to_real": {
        "data": set(),
        "fit": {"data"},
        "search": {"data", "fit"},
        "variance": {"data", "fit"},
        "evidence": {"data", "fit", "search"},
        "decision": {"data", "fit", "search", "variance", "evidence"},
    },
    "arctrack": {
        "recording": set(),
        "control": {"recording"},
        "report": set(),
        "simulation": {"recording", "control", "report"},
        "diagnose": {"recording", "report"},
        "plan": {"report"},
        "replay": {"recording", "control", "report", "diagnose"},
        "check": {"recording", "report", "replay"},
        "live": {"recording", "control", "simulation", "replay"},
        "calibrate": {"recording", "report", "check"},
        "bead": {"recording", "report", "calibrate"},
        "cli": {
            "recording",
            "control",
            "simulation",
            "diagnose",
            "plan",
            "replay",
            "check",
            "live",
            "calibrate",
            "bead",
        },
    },
    "validation": {
        "anywhere": set(),
        "bench": {"anywhere"},
        "second_renderer": set(),
        "blind_check": {"second_renderer"},
        "fault_schedules": set(),
        "figures": set(),
    },
}
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
MAX_FUNCTION_LINES = 100
MAX_POSITIONAL = 7

NAMES_SAYING_NOTHING = {"of", "one", "found", "at", "left"}
ONLY_IN_ARCTRACK = {"matplotlib", "jinja2", "rich", "typer", "pydantic", "av", "aiohttp", "prometheus_client"}


@functools.cache
def parsed(source: str) -> ast.Module:
    """Return a source's tree: several tests look at the same."""
    return ast.parse(source)


def imported(source: str, path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and top-level package of every import, relative and late ones included."""
    room = path.relative_to(ROOT).parts[0]
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name.split(".")[0]
        elif isinstance(node, ast.ImportFrom):
            depth = len(path.relative_to(ROOT).parts) - 1
            above_room = node.level > depth
            yield (
                node.lineno,
                "beyond" if above_room else room if node.level else (node.module or "").split(".")[0],
            )
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "import_module" and node.args:
            name = node.args[0]
            if isinstance(name, ast.Constant) and isinstance(name.value, str):
                yield node.lineno, name.value.split(".")[0]


def wrong_imports(path: Path) -> list[str]:
    """Return what a file imports against the table."""
    room = path.relative_to(ROOT).parts[0]
    forbidden = (set(MAY_IMPORT) - MAY_IMPORT[room] - {room}) | {"beyond"}
    if room not in {"arctrack", "validation"}:
        forbidden |= ONLY_IN_ARCTRACK
    return [
        f"{path.relative_to(ROOT)}:{line} imports {package}"
        for line, package in imported(path.read_text(), path)
        if package in forbidden
    ]


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_rooms_import_only_what_the_table_allows(room: str) -> None:
    files = sorted((ROOT / room).rglob("*.py"))
    assert files
    assert [wrong for file in files for wrong in wrong_imports(file)] == []


@pytest.mark.parametrize(
    "source",
    [
        "import tracker.step",
        "def f():\n    from arctrack import replay",
        "from ..tracker import step",
        "import importlib\nimportlib.import_module('robot_io.protocol.codec')",
        "import matplotlib.pyplot as plt",
    ],
)
def test_the_table_is_enforced(source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "noise_model").mkdir()
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    file = tmp_path / "noise_model" / "bad.py"
    file.write_text(source)
    assert len(wrong_imports(file)) == 1


def imported_files(file: Path) -> Iterator[Path]:
    """Yield the files of a file's own room that it imports, late imports included."""
    for node in ast.walk(parsed(file.read_text())):
        if isinstance(node, ast.Import):
            names = [[alias.name] for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [[f"{node.module}.{alias.name}", node.module] for alias in node.names]
        else:
            continue
        for candidates in names:
            places = [ROOT.joinpath(*name.split(".")) for name in candidates]
            files = [path for place in places for path in (place.with_suffix(".py"), place / "__init__.py")]
            known = next((path for path in files if path.is_file()), None)
            if known is not None and room_of(known) == room_of(file):
                yield known


def room_of(file: Path) -> str:
    return file.relative_to(ROOT).parts[0]


def part_of(file: Path) -> str:
    """Return the folder of a room, or the file in its root, that holds a file."""
    return file.relative_to(ROOT).parts[1]


def wrong_folders(room: str) -> list[str]:
    """Return what files in a room's folders import from other folders against the table."""
    allowed = FOLDERS_MAY_IMPORT[room]
    return [
        f"{file.relative_to(ROOT)} imports {used.relative_to(ROOT)}"
        for folder in allowed
        for file in sorted((ROOT / room / folder).rglob("*.py"))
        for used in imported_files(file)
        if part_of(used) in set(allowed) - allowed[folder] - {folder}
    ]


def check_no_circle(room: str) -> None:
    """Raise CycleError where a room's files import in a circle, or its folders and the files in its root."""
    files, parts = TopologicalSorter[Path](), TopologicalSorter[str]()
    for file in sorted((ROOT / room).rglob("*.py")):
        for used in imported_files(file):
            files.add(file, used)
            if part_of(used) != part_of(file):
                parts.add(part_of(file), part_of(used))
    files.prepare()
    parts.prepare()


@pytest.mark.parametrize("room", [room for room, folders in FOLDERS_MAY_IMPORT.items() if folders])
def test_the_page_on_the_architecture_lists_all_folders_in_an_order_that_holds(room: str) -> None:
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text()
    table = page.partition("| package | folders, in order |")[2].partition("\n\n")[0]
    (row,) = (line for line in table.splitlines() if line.startswith(f"| `{room}` |"))
    listed = re.findall(r"`(\w+)`", row)[1:]
    allowed = FOLDERS_MAY_IMPORT[room]
    assert sorted(listed) == sorted(allowed)
    assert [name for n, name in enumerate(listed) if allowed[name] - set(listed[:n])] == []


@pytest.mark.slow
@pytest.mark.parametrize("room", MAY_IMPORT)
def test_folders_import_only_what_the_table_allows_and_never_in_a_circle(room: str) -> None:
    assert set(FOLDERS_MAY_IMPORT[room]) == {path.parent.name for path in (ROOT / room).glob("*/__init__.py")}
    assert wrong_folders(room) == []
    check_no_circle(room)


def test_the_order_of_folders_is_enforced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    for file, source in {
        "stripe/fit.py": "from tracker import step",
        "stripe/read.py": "def f():\n    from tracker.seam.steer import steer",
        "seam/steer.py": "",
        "step.py": "import tracker.stripe.read",
    }.items():
        (tmp_path / "tracker" / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "tracker" / file).write_text(source)
    assert wrong_folders("tracker") == ["tracker/stripe/read.py imports tracker/seam/steer.py"]
    # From file to file nothing runs back; from the folder to the root's file and back it does.
    with pytest.raises(CycleError, match=r"step\.py"):
        check_no_circle("tracker")


def test_files_say_what_they_compute() -> None:
    vague = {"run.py", "utils.py", "helpers.py", "common.py"}
    named = {path for room in MAY_IMPORT for path in (ROOT / room).rglob("*.py") if path.name in vague}
    assert named == set()


@pytest.mark.slow
def test_no_function_is_longer_than_a_hundred_lines() -> None:
    long = [
        f"{file.relative_to(ROOT)}:{node.lineno} {node.name}"
        for folder in (*MAY_IMPORT, "benchmarks", "examples", "tests")
        for file in sorted((ROOT / folder).rglob("*.py"))
        for node in ast.walk(parsed(file.read_text()))
        if isinstance(node, FUNCTIONS)
        and (node.end_lineno or node.lineno) - node.lineno + 1 > MAX_FUNCTION_LINES
    ]
    assert long == []


def wide_calls(source: str) -> list[str]:
    """Return the calls with more arguments by position than one can hold apart; `*more` counts as one."""
    calls = (node for node in ast.walk(parsed(source)) if isinstance(node, ast.Call))
    return [ast.unparse(call.func) for call in calls if len(call.args) > MAX_POSITIONAL]


@pytest.mark.slow
def test_no_call_has_more_than_seven_arguments_by_position() -> None:
    wide = [
        f"{path.relative_to(ROOT)}: {name}"
        for room in MAY_IMPORT
        for path in (ROOT / room).rglob("*.py")
        for name in wide_calls(path.read_text())
    ]
    assert wide == []


def test_a_wide_call_is_seen() -> None:
    assert wide_calls("fit(1, 2, 3, 4, 5, 6, 7, 8)\nfit(1, 2, 3, 4, 5, 6, 7, rest=8)\n") == ["fit"]


def names_that_say_nothing(source: str) -> list[str]:
    """Return the variables and arguments that `NAMES_SAYING_NOTHING` holds, fields of classes left out.

    `left` beside `right` in one function says a side.
    """
    tree = parsed(source)
    fields = {id(item) for node in ast.walk(tree) if isinstance(node, ast.ClassDef) for item in node.body}
    scopes = [node for node in ast.walk(tree) if isinstance(node, (*FUNCTIONS, ast.Module))]
    wrong = set()
    for scope in scopes:
        names = {}
        todo: list[ast.AST] = [scope]
        while todo:
            node = todo.pop()
            if isinstance(node, ast.arg):
                names[node.arg] = node.lineno
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                names[node.id] = node.lineno
            inner = FUNCTIONS if isinstance(scope, ast.Module) else ()
            todo += [
                child
                for child in ast.iter_child_nodes(node)
                if not isinstance(child, inner)
                and not (isinstance(child, ast.AnnAssign | ast.Assign) and id(child) in fields)
            ]
        allowed = {"left"} if "right" in names else set()
        wrong |= {(names[name], name) for name in NAMES_SAYING_NOTHING & set(names) - allowed}
    return [f"{line} {name}" for line, name in sorted(wrong)]


def code_lines(source: str) -> list[tuple[int, str]]:
    """Return the lines that hold code or text, with their numbers: no imports, comments or lone brackets."""
    imports = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Import | ast.ImportFrom)]
    imported = {n for node in imports for n in range(node.lineno, (node.end_lineno or node.lineno) + 1)}
    lines = [(n, line.strip()) for n, line in enumerate(source.splitlines(), 1) if n not in imported]
    return [(n, line) for n, line in lines if not line.startswith("#") and re.search(r"\w", line)]


def repeated(sources: dict[str, str], run: int = 6) -> list[list[str]]:
    """Return where the same run of lines stands more than once, as FILE:LINE of each place."""
    places: dict[tuple[str, ...], list[str]] = {}
    for name, source in sources.items():
        lines = code_lines(source)
        for first in range(len(lines) - run + 1):
            text = tuple(line for _, line in lines[first : first + run])
            places.setdefault(text, []).append(f"{name}:{lines[first][0]}")
    return [where for where in places.values() if len(where) > 1]


@pytest.mark.slow
def test_no_six_lines_stand_twice() -> None:
    # Kernels repeat each other's arguments: these cannot be packed without cost.
    rooms = [room for room in MAY_IMPORT if room not in ("noise_model", "tracker", "validation")]
    files = [file for room in rooms for file in sorted((ROOT / room).rglob("*.py"))]
    assert repeated({str(file.relative_to(ROOT)): file.read_text() for file in files}) == []
    assert repeated({"a": "# one\n".join(f"x{n} = {n}\n" for n in range(6)) * 2}) == [["a:1", "a:12"]]


@pytest.mark.slow
def test_names_say_what_they_hold() -> None:
    wrong = [
        f"{file.relative_to(ROOT)}:{name}"
        for room in MAY_IMPORT
        for file in sorted((ROOT / room).rglob("*.py"))
        for name in names_that_say_nothing(file.read_text())
    ]
    assert wrong == []


@pytest.mark.parametrize(
    ("source", "wrong"),
    [
        ("def f(of, n):\n    return n", ["1 of"]),
        ("at = 1", ["1 at"]),
        ("def f():\n    return [one for one in range(3)]", ["2 one"]),
        ("def f():\n    n, found = g()", ["2 found"]),
        ("def f():\n    left = 1", ["2 left"]),
        ("def f():\n    left, right = 1, 2", []),
        ("def f(right):\n    return right\ndef g(left):\n    return left", ["3 left"]),
        ("class Rate:\n    right: int\n    of: int", []),
        ("class Rate:\n    def share(self, of): ...", ["2 of"]),
    ],
)
def test_a_name_that_says_nothing_is_seen(source: str, wrong: list[str]) -> None:
    assert names_that_say_nothing(source) == wrong


def own_uses(tree: ast.Module) -> set[str]:
    """Return the names that a file reads outside of what they define, and the words of its texts."""
    names: set[str] = set()
    texts: list[str] = []

    def walk(node: ast.AST, within: frozenset[str]) -> None:
        if isinstance(node, (*FUNCTIONS, ast.ClassDef)):
            within |= {node.name}
        if isinstance(node, ast.Name) and node.id not in within:
            names.add(node.id)
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            texts.append(node.value)
        for child in ast.iter_child_nodes(node):
            if not (isinstance(node, ast.Expr) and isinstance(child, ast.Constant)):
                walk(child, within)

    walk(tree, frozenset())
    return names | {word for text in texts for word in re.findall(r"\w+", text)}


def dotted(node: ast.AST) -> str:
    """Return the name that attributes of names make, such as a module's; empty for anything else."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def used_by_tests_alone(sources: dict[str, str], texts: str = "") -> list[str]:
    """Return the public functions and classes, as MODULE.NAME, that no other part of the sources uses.

    Imports count by module, or by a package that hands the name on; words of `texts` count everywhere.
    """
    imported: dict[str, set[str]] = {}
    for source in sources.values():
        modules: dict[str, str] = {}
        for node in ast.walk(parsed(source)):
            if isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    imported.setdefault(alias.name, set()).add(node.module)
                    modules[alias.asname or alias.name] = f"{node.module}.{alias.name}"
            elif isinstance(node, ast.Import):
                modules |= {alias.asname or alias.name: alias.name for alias in node.names}
        for node in ast.walk(parsed(source)):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name | ast.Attribute):
                imported.setdefault(node.attr, set()).add(modules.get(dotted(node.value), ""))
    everywhere = set(re.findall(r"\w+", texts))
    unused = []
    for module, source in sources.items():
        tree = parsed(source)
        uses = own_uses(tree) | everywhere
        for node in tree.body:
            if not isinstance(node, (*FUNCTIONS, ast.ClassDef)) or node.name.startswith("_"):
                continue
            takers = imported.get(node.name, set())
            is_taken = any(f"{module}.".startswith(f"{taker}.") for taker in takers)
            if node.name not in uses and not is_taken:
                unused.append(f"{module}.{node.name}")
    return unused


@pytest.mark.slow
def test_what_tests_and_benchmarks_alone_use_is_not_in_the_wheel() -> None:
    product = [room for room in MAY_IMPORT if room != "validation"]
    files = {
        ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file.read_text()
        for room in product
        for file in sorted((ROOT / room).rglob("*.py"))
    }
    templates = [path.read_text() for path in sorted((ROOT / "arctrack").rglob("*.j2"))]
    texts = "\n".join([*templates, (ROOT / "pyproject.toml").read_text()])
    assert used_by_tests_alone(files, texts) == []


def test_what_tests_alone_use_is_seen() -> None:
    sources = {
        "room.made": "def far(): ...\ndef make(): return make()\ndef take(): ...\ndef hand_on(): ...\n",
        "room.other": "from room.made import take\nfrom room import hand_on, made as m\nm.far()\n",
        "room.spoken": "def run(): ...\nPROGRAM = 'import room.spoken; run()'\n",
    }
    assert used_by_tests_alone(sources) == ["room.made.make"]
    assert used_by_tests_alone(sources, texts="{{ make() }}") == []


def test_a_name_of_a_class_has_one_meaning() -> None:
    """No class name twice, not even of a record that one file alone uses."""
    homes: dict[str, list[str]] = {}
    for room in MAY_IMPORT:
        for file in sorted((ROOT / room).rglob("*.py")):
            for node in ast.walk(parsed(file.read_text())):
                if isinstance(node, ast.ClassDef):
                    homes.setdefault(node.name, []).append(str(file.relative_to(ROOT)))
    assert {name: files for name, files in homes.items() if len(files) > 1} == {}


@pytest.mark.slow
def test_names_imported_from_the_product_exist() -> None:
    # mypy looks at the product and its validation alone.
    wrong = []
    for file in (
        f for room in ("tests", "benchmarks", "examples") for f in sorted((ROOT / room).rglob("*.py"))
    ):
        for node in ast.walk(parsed(file.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in MAY_IMPORT:
                module = importlib.import_module(str(node.module))
                wrong += [
                    f"{file.relative_to(ROOT)}:{node.lineno} {alias.name}"
                    for alias in node.names
                    if not hasattr(module, alias.name)
                    and importlib.util.find_spec(f"{node.module}.{alias.name}") is None
                ]
    assert wrong == []


PRIVATE = re.compile(
    rf"""^\s*from\ (?:{"|".join(MAY_IMPORT)})\b.*\ import\ .*\b_[a-z]
    | setattr\((?:[\w.]+,\ )?"(?:[\w.]+\.)?_ | [.]__dict__\[""",
    re.VERBOSE,
)
PRIVATE_ALL_THE_SAME = {
    # A process that has warmed nothing up, and has warned of nothing, without starting one.
    'monkeypatch.setattr("tracker.warm_up._warm", set())',
    'monkeypatch.setattr(store, "_WARNED", set())',
    # One part of the light alone.
    "from noise_model.arc.ray import _light_of, light_at",
    # The same light by finer rules than any that the product offers.
    'monkeypatch.setattr(interreflection, "_first_rules", lambda _: rules(16, 6, 3, 5, 6, True))',
}


def test_tests_take_the_public_door() -> None:
    wrong = [
        f"{file.relative_to(ROOT)}: {line.strip()}"
        for file in sorted((ROOT / "tests").rglob("*.py"))
        for line in file.read_text().splitlines()
        if file != Path(__file__) and PRIVATE.search(line) and line.strip() not in PRIVATE_ALL_THE_SAME
    ]
    assert wrong == []


PROCESS_STARTS = re.compile(r"\b(Popen|ProcessPoolExecutor|get_context|fork|posix_spawnp?)\b|\bProcess\(")


def test_one_file_starts_processes() -> None:
    """What `ChildProcess` guarantees holds for all: see its docstring."""
    files = [file for room in MAY_IMPORT for file in (ROOT / room).rglob("*.py")]
    starting = [file for file in files if PROCESS_STARTS.search(file.read_text())]
    assert starting == [ROOT / "arctrack" / "child_process.py"]


@pytest.mark.slow
def test_bounds_are_named_min_and_max() -> None:
    wrong = [
        f"{file.relative_to(ROOT)}:{name}"
        for room in (*MAY_IMPORT, "benchmarks", "tests")
        for file in sorted((ROOT / room).rglob("*.py"))
        for name in re.findall(
            r"\b_?(?:most|least)_(?!squares|common|likely|above)\w+", file.read_text(), re.I
        )
    ]
    assert wrong == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [["ruff", "check", "."], ["ruff", "format", "--check", "."], ["mypy"], ["vulture"]],
    ids=["lint", "format", "types", "dead code"],
)
def test_code_is_clean(command: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_what_dead_code_leaves_out_is_there_and_unused() -> None:
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["vulture"]["ignore_names"]
    command = [sys.executable, "-m", "vulture", "--ignore-names", "none"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    unused = re.findall(r"unused \S+ '(.*)'", done.stdout)
    assert [name for name in known if not fnmatch.filter(unused, name)] == []


def test_hooks_are_well_formed() -> None:
    command = [sys.executable, "-m", "pre_commit", "validate-config", ROOT / ".pre-commit-config.yaml"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_readme_opens_with_two_commands() -> None:
    text = (ROOT / "README.md").read_text()
    block = text.split("```sh\n", 1)[1].split("```", 1)[0].strip().splitlines()
    assert len(block) == 2
    assert "arctrack replay examples/" in block[0]
    assert "pytest" in block[1]
    assert all(line.startswith("python3 -m venv ") for line in block)


def test_changelog_opens_with_the_version_that_is_built() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    released = re.findall(r"^## \[(\d[^\]]*)\] - \d{4}-\d\d-\d\d$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert released[0] == project["version"]


def holds_arrays(hint: object) -> bool:
    """Say whether a type is that of an array, or of a tuple or a record with one."""
    if typing.get_origin(hint) is np.ndarray:
        return True
    parts = typing.get_type_hints(hint).values() if hasattr(hint, "_fields") else typing.get_args(hint)
    return any(map(holds_arrays, parts))


@pytest.mark.slow
def test_a_kernel_that_counts_references_gets_no_arrays_of_one_that_does_not() -> None:
    # It would give back a reference that nobody took: the array's memory is freed while it is in use.
    modules = [
        importlib.import_module(module.name)
        for room in ("noise_model", "tracker", "calibration")
        for module in pkgutil.walk_packages([str(ROOT / room)], f"{room}.")
    ]
    found = {f for module in modules for f in vars(module).values() if isinstance(f, Dispatcher)}
    counting = [kernel for kernel in found if kernel.targetoptions.get("_nrt", True)]
    assert 0 < len(counting) < len(found)
    wrong = {
        (kernel.__name__, called.__name__)
        for kernel in counting
        for called in map(kernel.py_func.__globals__.get, kernel.py_func.__code__.co_names)
        if isinstance(called, Dispatcher) and called not in counting
        if holds_arrays(typing.get_type_hints(called.py_func)["return"])
    }
    assert wrong == set()
