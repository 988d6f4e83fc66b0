"""Configuration reference, made of conf/, the signatures of its classes and their docstrings.

    python docs/config_reference.py     writes the page to the terminal

An option has the comment at the top of its YAML, and a table with a row for each key: default, type
and limits as the program checks them, and the meaning according to the docstring of the constructor
and the comment beside the key.
"""

from __future__ import annotations

import inspect
import logging
import pkgutil
import re
from pathlib import Path

import griffe
import yaml

from pinn_dyn.app.settings import SETTINGS
from pinn_dyn.run.configuration.defaults import defaults
from pinn_dyn.run.configuration.validation import arguments_model

ROOT = Path(__file__).resolve().parents[1]
CONF = ROOT / "conf"
PROGRAMS = ("train", "evaluate", "control", "gather", "check", "excite")
PLAIN = (bool, int, float, str, tuple, type(None))
# Keys of the programs that stand in no YAML.
OPTIONAL = {
    "start_from": "a run folder whose trained weights the training starts from.",
    "payload": "files with the columns of the log, recorded with a load that is identified.",
    "resume": "a run folder to go on with after an interruption, by its own configuration.",
    "trust": "packages whose classes the configuration of a run folder may build: SECURITY.md.",
}

HEAD = """# Configuration reference

Made from `conf/` and from the docstrings of the classes that it names, when this site is built.

- A **group** is a folder of `conf/`, an **option** a file in it: `model=lnn`,
  `model/damping=constant`.
- A **key** is changed by its dotted name: `trainer.steps=40000`, `model.mass.hidden=[64,64]`. What
  a class takes besides the keys of its YAML can be given as well: `loss.huber=0.01`.
- `???` has no default and must be given. `${...}` takes the value of another key, `${default:...}`
  a default that depends on the model and on the kind of data.
- `_target_` is the class that is built, its arguments are the keys beside it; the rest of what its
  constructor takes (scales of the data, the system) comes from the program.
- The columns of a data set in the logs are mappings: [CSV logs](csv_logs.md) explains them.

`python train.py --cfg job --resolve` prints the configuration that a command line makes, `--help`
the groups and examples.

## Defaults of a training

The command line and `pinn_dyn.train` have the same. `data=multi_step` takes those of a log for
simulated data.

| key | simulated data | log | exceptions |
|---|---|---|---|
"""
KINDS = {"simulated data": False, "log": True}
MODELS = {
    "hnn": "HamiltonianNetwork",
    "known": "KnownMechanics",
    "mlp": "NextStateMLP",
    "subnet": "SubspaceEncoder",
    "oscillators": "CoupledOscillators",
}


def config_reference() -> str:
    """The whole page, Markdown."""
    logging.getLogger("griffe").setLevel(logging.CRITICAL)
    package = griffe.load("pinn_dyn", search_paths=[str(ROOT)])
    parts = [HEAD + "\n".join(_training_defaults()), "\n## Programs"]
    for name in PROGRAMS:
        own = CONF / name / f"{name}.yaml"
        path = own if own.is_file() else CONF / f"{name}.yaml"
        parts.append(
            _option(package, path, f"{name}.py", "", level=3, types=_types(SETTINGS[name]))
        )
    for folder in sorted(path for path in CONF.rglob("*") if path.is_dir()):
        group = folder.relative_to(CONF).as_posix().removeprefix("control/")
        files = sorted(folder.glob("*.yaml"))
        if not files or group.startswith("experiment") or folder == CONF / "control":
            continue
        parts.append(f"## {group}")
        for file in files:
            choice = f"{'+' if group == 'debug' else ''}{group}={file.stem}"
            prefix = f"{group.replace('/', '.')}."
            parts.append(_option(package, file, choice, prefix, level=3))
    for program, folder in (("train", CONF), ("control", CONF / "control")):
        parts.append(f"## experiment of {program}.py\n")
        parts.append("Each is a difference from the defaults, `experiment=<name>`.\n")
        parts.append("| name | what |\n|---|---|")
        for path in sorted((folder / "experiment").rglob("*.yaml")):
            name = path.relative_to(folder / "experiment").with_suffix("").as_posix()
            parts.append(f"| `{name}` | {_cell(_comment(path.read_text().splitlines()))} |")
        parts.append("")
    return "\n".join(parts)


def _training_defaults() -> list[str]:
    """A row for each default of a training, with the models that have another one."""
    usual = {kind: defaults("", on_log=on_log) for kind, on_log in KINDS.items()}
    special: dict[str, list[str]] = {key: [] for key in usual["log"]}
    cases = {f"`{name}`": (target, False) for name, target in MODELS.items()}
    for name, (model, fitted) in {**cases, "least squares": ("", True)}.items():
        for kind, on_log in KINDS.items():
            values = defaults(model, on_log=on_log, least_squares=fitted)
            for key, value in values.items():
                if key not in usual[kind] or value != usual[kind][key]:
                    text = f"{name}, {kind}: {_plain(value)}"
                    special.setdefault(key, []).append(text)
    rows = []
    for key, texts in special.items():
        both = [_plain(values.get(key)) for values in usual.values()]
        rows.append(f"| `{key}` | {both[0]} | {both[1]} | {'; '.join(texts)} |")
    return rows


def _plain(value) -> str:
    if isinstance(value, dict):
        value = value["_target_"].rpartition(".")[2]
    return "–" if value is None else f"{value}"


def _option(package, path: Path, title: str, prefix: str, level: int, types=None) -> str:
    """One YAML: its heading, comment and table."""
    lines = path.read_text().splitlines()
    if any(line.startswith("# @package _global_") for line in lines):
        prefix = ""
    rows = _rows(package, lines, yaml.compose(path.read_text()), prefix, types or {})
    text = f"\n{'#' * level} `{title}`\n\n{_cell(_comment(lines))}\n"
    if rows:
        text += "\n| key | default | type | meaning |\n|---|---|---|---|\n" + "\n".join(rows) + "\n"
    return text


def _rows(package, lines: list[str], node: yaml.Node, prefix: str, types) -> list[str]:
    """A row for each key of a mapping, and of the mappings inside."""
    target = next((v.value for k, v in node.value if k.value == "_target_"), None)
    described = _arguments(package, target) if target else {}
    types = _types(_imported(target)) if target else types
    rows = []
    if target:
        rows.append(f"| `{prefix}_target_` | {_linked(package, target)} | | |")
    for key, value in node.value:
        name = key.value
        if name in ("_target_", "_partial_") or (not prefix and name == "hydra"):
            continue
        if name == "defaults":
            rows.extend(_defaults(value))
            continue
        meaning = [described.get(name, ""), _beside(lines, key, value)]
        text = _cell(" ".join(part.rstrip(".") + "." for part in meaning if part))
        kind = f"{_cell(types[name])} " if types.get(name) else ""
        if isinstance(value, yaml.MappingNode) and value.value and not value.flow_style:
            rows.append(f"| **`{prefix}{name}`** | | | {text} |")
            rows.extend(_rows(package, lines, value, f"{prefix}{name}.", {}))
        elif classes := _classes(package, value):
            rows.append(f"| `{prefix}{name}` | {', '.join(classes)} | {kind}| {text} |")
        else:
            rows.append(f"| `{prefix}{name}` | {_value(value)} | {kind}| {text} |")
    there = {key.value for key, _ in node.value}
    if target and described:
        rows.extend(_unlisted(target, prefix, types, described, there))
    elif not prefix:
        rows.extend(
            f"| `{name}` | | {_cell(types[name])} | {text} |"
            for name, text in OPTIONAL.items()
            if name in types and name not in there
        )
    return rows


def _unlisted(target: str, prefix: str, types, described, there) -> list[str]:
    """Rows for what a class takes besides the keys of its YAML."""
    return [
        f"| `{prefix}{name}` | `{'null' if one.default is None else one.default}` "
        f"| {_cell(types[name])} | {_cell(described[name])} |"
        for name, one in inspect.signature(pkgutil.resolve_name(target)).parameters.items()
        if name in described and name not in there and isinstance(one.default, PLAIN)
    ]


def _defaults(value: yaml.SequenceNode) -> list[str]:
    """The groups that a defaults list chooses from."""
    rows = []
    for item in value.value:
        if isinstance(item, yaml.MappingNode):
            ((group, option),) = item.value
            name = group.value.removeprefix("override ").lstrip("/")
            shown = "none" if option.value == "null" else f"`{option.value}`"
            rows.append(f"| `{name}=` | {shown} | group | |")
    return rows


def _imported(target: str):
    """Return the class of a name; None of a package that need not be installed."""
    try:
        return pkgutil.resolve_name(target)
    except ImportError:
        return None


def _types(target) -> dict[str, str]:
    """Return the types and limits of the arguments of a class, as the program checks them."""
    if target is None:
        return {}
    properties = arguments_model(target).model_json_schema().get("properties", {})
    return {key: _type(schema) for key, schema in properties.items()}


_NAMES = {"integer": "whole number", "boolean": "true or false", "string": "text"}
_LIMITS = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}


def _type(schema: dict) -> str:
    """Return a JSON schema in words; nothing where any value is accepted."""
    if options := schema.get("anyOf"):
        return " or ".join(dict.fromkeys(map(_type, options)))
    if choices := schema.get("enum", [schema["const"]] if "const" in schema else []):
        return " or ".join(f"`{choice}`" for choice in choices)
    kind = schema.get("type", "")
    limits = [f"{sign} {schema[key]}" for key, sign in _LIMITS.items() if key in schema]
    if kind == "array":
        items = schema.get("items", {})
        kind = f"list ({_type(items)})" if items else "list"
    elif kind == "object":
        # A field without an annotation of its own has its key for a title.
        is_class = "additionalProperties" not in schema and "title" in schema
        kind = schema["title"] if is_class else "mapping"
    return " ".join([_NAMES.get(kind, kind), *limits])


def _arguments(package, target: str) -> dict[str, str]:
    """What the docstring of a class of this package says about each argument."""
    found = _find(package, target)
    texts: dict[str, str] = {}
    if found is None or found.docstring is None:
        return texts
    for section in found.docstring.parse("google", warnings=False):
        if section.kind is griffe.DocstringSectionKind.parameters:
            for entry in section.value:
                for name in entry.name.split(", "):
                    texts[name] = " ".join(entry.description.split()).replace("``", "`")
    return texts


def _find(package, target: str):
    """The class or function of this package that a target names, or None."""
    if not target.startswith("pinn_dyn."):
        return None
    found = package[target.removeprefix("pinn_dyn.")]
    return found.final_target if found.is_alias else found


def _linked(package, target: str) -> str:
    if target.startswith("pinn_dyn.app.") or _find(package, target) is None:  # without a page
        return f"`{target}`"
    return f"[`{target.rsplit('.', 1)[-1]}`][{target}]"


def _classes(package, value: yaml.Node) -> list[str]:
    """The classes of a list of objects."""
    if not isinstance(value, yaml.SequenceNode):
        return []
    items = [item.value for item in value.value if isinstance(item, yaml.MappingNode)]
    targets = [v.value for item in items for k, v in item if k.value == "_target_"]
    return [_linked(package, target) for target in targets]


def _value(node: yaml.Node) -> str:
    if isinstance(node, yaml.ScalarNode):
        return f"`{node.value}`" if node.value else '`""`'
    text = node.start_mark.buffer[node.start_mark.index : node.end_mark.index].strip("\0")
    return "`" + " ".join(text.split()) + "`"


def _beside(lines: list[str], key: yaml.Node, value: yaml.Node) -> str:
    """The comments above a key and at the end of its line."""
    above = []
    line = key.start_mark.line - 1
    while line > 0 and lines[line].lstrip().startswith("#"):
        above.insert(0, lines[line].lstrip("# "))
        line -= 1
    if line == 0 and lines[0].startswith("#"):
        above = []  # that is the comment of the whole file
    block = isinstance(value, yaml.CollectionNode) and not value.flow_style
    end = key.end_mark if block else value.end_mark
    rest = lines[end.line][end.column :].lstrip(": ") if end.line < len(lines) else ""
    comment = rest.lstrip("# ") if rest.startswith("#") else ""
    return " ".join([*above, comment]).strip()


def _comment(lines: list[str]) -> str:
    """The comment at the top of a file."""
    text = []
    for line in lines:
        if not line.startswith("#"):
            break
        if "@package" not in line:
            text.append(line[1:].strip())
    return " ".join(text)


def _cell(text: str) -> str:
    """Text for a table: what Markdown would read as markup is escaped, but for code."""
    parts = re.split(r"(`[^`]*`)", text)
    parts[::2] = [re.sub(r"([*_<\[\]])", r"\\\1", part) for part in parts[::2]]
    return "".join(parts).replace("|", "\\|")


if __name__ == "__main__":
    print(config_reference())
