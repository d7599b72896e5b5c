"""Reference pages that are read from the code: tables of settings and quantities, and one API page per package."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import pkgutil
import re
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
from sphinx.application import Sphinx

from latentplan.config.quantities import QUANTITIES

SPECIAL = re.compile(r"(^ *[*-] |``.*?``|`[^`]*`)|([*|])|(?<=\w)(_)(?!\w)", flags=re.DOTALL)
SHORT_CODE = 32  # characters
SECTIONS = {f"{name}:" for name in ("Args", "Attributes", "Returns", "Raises", "Yields", "Note", "Example", "Examples")}


def escape_markup(app: Sphinx, what: str, name: str, subject: Any, options: Any, lines: list[str]) -> None:
    """Escape markup in docstrings, which are plain text with single backticks; indented blocks become literal ones."""
    result: list[str] = []
    block: int | None = None  # indentation of the text that the present literal block belongs to
    for number, line in enumerate(lines):
        indent = _indent(line)
        if block is not None and line.strip() and indent <= block:
            block = None
            if result[-1].strip():
                result.append("")
        if block is None and line.strip() and _opens_block(lines, number):
            block = indent
            result += [_escaped(line) + ("" if line.endswith("::") else ":" if line.endswith(":") else " ::"), ""]
        else:
            result.append(line if block is not None else _escaped(line))
    lines[:] = [_as_description(line, before) for line, before in zip(result, ["", *result], strict=False)]


def _as_description(line: str, before: str) -> str:
    """The first line below "Returns:", marked as a description where Napoleon would read text and colon as a type."""
    is_first = before.strip() in ("Returns:", "Yields:")
    return re.sub(r"^( *)", r"\1: ", line, count=1) if is_first and ":" in line else line


def _opens_block(lines: list[str], number: int) -> bool:
    """Whether a line of prose is followed by a more deeply indented block, which is not a section or a list item."""
    line, rest = lines[number], lines[number + 1 :]
    after = next((other for other in rest if other.strip()), "")
    deeper = _indent(after) > _indent(line)
    is_entry = re.match(r"^\s*(?:[*-] |\d+\. )|^\s+[\w*, ]+(?: \([^)]*\))?: ", line) or line.strip() in SECTIONS
    return deeper and not is_entry


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip())


def hide_dataclass_text(app: Sphinx, what: str, name: str, subject: Any, options: Any, lines: list[str]) -> None:
    """Drop the signature that Python writes as the docstring of a dataclass without one."""
    if lines and re.match(r"^\w+\(.*\)$", lines[0]) and len(lines) <= 2 and inspect.isclass(subject):
        lines.clear()


def keep_property_text(app: Sphinx, what: str, name: str, subject: Any, options: Any, lines: list[str]) -> None:
    """Put back the text of a property, whose first sentence Napoleon takes for a type where it holds a colon."""
    getter = getattr(subject, "fget", getattr(subject, "func", None))
    if what == "property" and getter is not None and any(line.startswith(":type:") for line in lines):
        lines[:] = [_escaped(line) for line in (inspect.getdoc(getter) or "").splitlines()]


def keep_short_code_whole(app: Sphinx, doctree: nodes.document) -> None:
    """Marks inline code that fits on a line, so that it is not broken at its hyphens."""
    for code in doctree.findall(nodes.literal):
        if len(code.astext()) <= SHORT_CODE:
            code["classes"].append("short")


class Api(Directive):
    """`.. api:: latentplan.room` documents the public names of a package, then those of its other modules."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The parsed `automodule` directives of the package."""
        package = importlib.import_module(self.arguments[0])
        exported = list(getattr(package, "__all__", []))
        seen = {id(getattr(package, name)) for name in exported}
        members = f":members: {', '.join(exported)}" if exported else ":no-members:"
        text = [f".. automodule:: {package.__name__}", f"   {members}", ""]
        for module in _modules_below(package):
            public = [name for name, value in vars(module).items() if _belongs(name, value, module, seen)]
            if public:
                title = module.__name__.removeprefix(f"{package.__name__}.")
                text += [f".. rubric:: {title}", "", f".. automodule:: {module.__name__}"]
                text += [f"   :members: {', '.join(public)}", *(["   :no-index:"] if title in exported else []), ""]
        return _parse(self, text)


class Settings(Directive):
    """`.. settings:: latentplan.config.DistillConfig` makes a table of a dataclass; of `Config` one per section."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """One section per dataclass, with a table of name, default and meaning."""
        module, _, name = self.arguments[0].rpartition(".")
        settings = getattr(importlib.import_module(module), name)
        sections = {
            field.name: field.default_factory
            for field in dataclasses.fields(settings)
            if dataclasses.is_dataclass(field.default_factory)
        } or {"": settings}
        text: list[str] = []
        for prefix, section in sections.items():
            text += _settings_table(prefix, section)
        return _parse(self, text)


class Quantities(Directive):
    """`.. quantities::` makes a table of the named quantities of every domain."""

    def run(self) -> list[nodes.Node]:
        """One table with domain, name, unit, scale and meaning."""
        text = [".. list-table::", "   :header-rows: 1", ""]
        text += ["   * - domain", "     - name", "     - unit", "     - scale", "     - meaning"]
        for domain, quantities in QUANTITIES.items():
            for number, quantity in enumerate(quantities):
                text += [f"   * - {'' if number else domain}", f"     - ``{quantity.name}``"]
                text += [
                    f"     - {quantity.unit}",
                    f"     - {quantity.scale:g}",
                    f"     - {_escaped(quantity.meaning)}",
                ]
        return _parse(self, [*text, ""])


def _settings_table(prefix: str, settings: Any) -> list[str]:
    first_line = (inspect.getdoc(settings) or "").splitlines()[0]
    meanings: dict[str, str] = {}
    for kind in reversed(settings.__mro__):
        meanings |= _described_fields(kind.__doc__ or "")
    title = f"{prefix}: {first_line}" if prefix else first_line
    text = [f".. rubric:: {_escaped(title)}", "", ".. list-table::", "   :header-rows: 1", "   :class: settings", ""]
    text += ["   * - setting", "     - default", "     - meaning"]
    for field in dataclasses.fields(settings):
        name = f"{prefix}.{field.name}" if prefix else field.name
        meaning = meanings.get(field.name)
        if meaning is None:
            raise ValueError(f"{settings.__name__}.{field.name} has no line under Attributes")
        text += [f"   * - ``{name}``", f"     - ``{_default(field)}``", f"     - {_escaped(meaning)}"]
    return [*text, ""]


def _described_fields(docstring: str) -> dict[str, str]:
    """The lines below "Attributes:" by the name they describe."""
    _, _, listed = docstring.partition("Attributes:")
    found: dict[str, str] = {}
    names: list[str] = []
    for line in inspect.cleandoc("x\n" + listed).splitlines()[1:] if listed else []:
        if match := re.match(r"^ {0,4}(\w+(?:, \w+)*): +(.*)$", line):
            names = match[1].split(", ")
            found |= dict.fromkeys(names, match[2])
        elif not line.strip() or re.match(r"^\w+:$", line.strip()):
            names = []
        else:
            found |= {name: f"{found[name]} {line.strip()}" for name in names}
    return found


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is dataclasses.MISSING:
        return "required" if field.default_factory is dataclasses.MISSING else str(field.default_factory())
    words = {None: "null", True: "true", False: "false"}  # as in YAML
    return words[field.default] if field.default is None or isinstance(field.default, bool) else str(field.default)


def _escaped(text: str) -> str:
    return SPECIAL.sub(lambda found: found[1] or "\\" + (found[2] or found[3]), text)


def _modules_below(package: Any) -> list[Any]:
    found = pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    return [importlib.import_module(module.name) for module in found]


def _belongs(name: str, value: Any, module: Any, seen: set[int]) -> bool:
    """Whether a name is a public class or function that this module defines and that stands nowhere above."""
    is_own = getattr(value, "__module__", None) == module.__name__ and id(value) not in seen
    return is_own and not name.startswith("_") and (inspect.isclass(value) or inspect.isfunction(value))


def _parse(directive: Directive, text: list[str]) -> list[nodes.Node]:
    holder = nodes.section()
    holder.document = directive.state.document
    directive.state.nested_parse(StringList(text, source="generated"), 0, holder)
    return holder.children


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directives."""
    app.add_directive("api", Api)
    app.add_directive("settings", Settings)
    app.add_directive("quantities", Quantities)
    app.connect("doctree-read", keep_short_code_whole)
    app.connect("autodoc-process-docstring", hide_dataclass_text, priority=100)
    app.connect("autodoc-process-docstring", escape_markup, priority=200)
    app.connect("autodoc-process-docstring", keep_property_text, priority=600)  # after napoleon, which has 500
    return {"parallel_read_safe": True}
