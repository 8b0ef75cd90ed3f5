"""Manual pages from the declarations of the commands and settings: ``pages()`` gives their text by file name.

``rmpa(1)`` is the overview; a family of commands (``rmpa topic ...``) has one page, a command outside of families its
own; ``rmpa.toml(5)`` has every setting. The words are those of ``--help`` and docs/reference/settings.md.
"""

import datetime as dt
import re
from collections.abc import Iterator

import click

from rmpa.cli.main import VERBS, cli
from rmpa.config.settings import SETTINGS, TABLES, toml_value

EXAMPLE = re.compile(r"(\S.*?)\s{2,}(\S.*)|(\S.*)")
FILES = {
    "/etc/rmpa/rmpa.toml": "Settings of this machine, unless there is a ./rmpa.toml or ~/.config/rmpa/rmpa.toml.",
    "/var/lib/rmpa": "What the service keeps: its name, keys, registrations and parameters.",
    "/run/rmpa": "The control socket of the service, which root and members of the group rmpa may use.",
    "/usr/share/doc/rmpa/docs": "The documentation that these pages call docs/.",
}
STATUS = {
    "0": "Success.",
    "1": "Failure; the reason is on standard error.",
    "2": "A usage error: an option, a variable, a line of rmpa.toml.",
    "130, 141": "Ended by Ctrl-C; by a closed pipe.",
}


def pages(version: str, date: int) -> dict[str, str]:
    """The text of each page, by its file name.

    Args:
        version: The version that they show.
        date: The day that the pages show, in seconds since 1970.
    """
    day = dt.datetime.fromtimestamp(date, dt.UTC).date().isoformat()
    root = click.Context(cli, info_name="rmpa", **cli.context_settings)
    found = {"rmpa.1": overview(root), "rmpa.toml.5": settings()}
    for name, command in members(cli, root):
        found[f"rmpa-{name}.1"] = family(command, child(root, name, command))
    return {name: "\n".join((head(name, version, day), *lines)) + "\n" for name, lines in found.items()}


def head(name: str, version: str, day: str) -> str:
    """The macro that begins a page."""
    title, _, section = name.rpartition(".")
    return f'.TH "{escaped(title.upper())}" "{section}" "{day}" "rmpa {escaped(version)}" "RMPA"\n.ad l\n.nh'


def members(group: click.Group, ctx: click.Context) -> Iterator[tuple[str, click.Command]]:
    """The commands of a group by name."""
    for name in group.list_commands(ctx):
        command = group.get_command(ctx, name)
        assert command is not None
        yield name, command


def child(parent: click.Context, name: str, command: click.Command) -> click.Context:
    """The context of a command of a group."""
    return click.Context(command, info_name=name, parent=parent, terminal_width=10_000, max_content_width=10_000)


def overview(ctx: click.Context) -> list[str]:
    """The page rmpa(1)."""
    lines = [
        *name_section("rmpa", cli.help or ""),
        ".SH SYNOPSIS",
        synopsis(cli, ctx),
        ".SH DESCRIPTION",
        *prose(cli.help),
    ]
    lines.append(".SH COMMANDS")
    for name, _ in members(cli, ctx):
        tag = f"\\fB{escaped(f'rmpa-{name}')}\\fR(1)"
        lines += [".TP", tag, filled(VERBS[name][1])]
    lines += [".SH OPTIONS", *options(cli, ctx), *prose(cli.epilog)]
    for title, table in (("EXIT STATUS", STATUS), ("FILES", FILES)):
        lines.append(f'.SH "{title}"')
        for tag, text in table.items():
            lines += [".TP", f".B {escaped(tag)}", filled(text)]
    return [*lines, '.SH "SEE ALSO"', ".BR rmpa.toml (5)"]


def family(command: click.Command, ctx: click.Context) -> list[str]:
    """The page of a family of commands, or of one command."""
    lines = [*name_section(ctx.command_path.replace(" ", "-"), VERBS[ctx.info_name or ""][1]), ".SH SYNOPSIS"]
    parts = list(members(command, ctx)) if isinstance(command, click.Group) else []
    own = [(command, ctx)] if not parts or command.params else []
    each = own + [(part, child(ctx, name, part)) for name, part in parts]
    lines += [f"{synopsis(part, at)}\n.br" for part, at in each]
    lines += [".SH DESCRIPTION", *prose(command.help), *prose(command.epilog)]
    if own:
        lines += [".SH OPTIONS", *options(command, ctx)]
    if parts:
        lines.append(".SH COMMANDS")
    for part, at in each[len(own) :]:
        lines += [f'.SS "{escaped(at.command_path)}"', synopsis(part, at), ".PP", *prose(part.help)]
        lines += [*options(part, at), *prose(part.epilog)]
    return [*lines, '.SH "SEE ALSO"', ".BR rmpa (1),", ".BR rmpa.toml (5)"]


def settings() -> list[str]:
    """The page rmpa.toml(5)."""
    about = "settings of rmpa, in TOML"
    lines = [".SH NAME", f"rmpa.toml \\- {about}", ".SH SYNOPSIS", ".I ./rmpa.toml\n.br\n.I ~/.config/rmpa/rmpa.toml"]
    lines += [".br\n.I /etc/rmpa/rmpa.toml", ".SH DESCRIPTION"]
    lines.append(filled("The first of these files that is there is read; --config names another one."))
    lines.append(filled("`rmpa config show` prints the settings that hold, and where each comes from."))
    for table in ("", *TABLES):
        rows = [s for s in SETTINGS if not s.is_list_of_tables and ".".join(s.key[:-1]) == table and s.key]
        lines += [f'.SH "[{escaped(table)}]"', filled(TABLES[table])] if table else ['.SH "ABOVE THE FIRST TABLE"']
        for row in rows:
            default = row.shown_default or f"`{toml_value(row.default)}`"
            sources = [f"Default: {default}."]
            sources += [f"Option: `{row.option}`."] if row.option else []
            sources += [f"Variable: `{row.env}`."] if row.env else []
            sources += ["`rmpa reload` applies a change."] if row.live else []
            lines += [".TP", f".B {escaped(row.key[-1])}", filled(row.help), ".br", filled(" ".join(sources))]
    for setting in SETTINGS:
        if setting.is_list_of_tables:
            lines += [f'.SH "{escaped(setting.title)}"', filled(setting.help)]
            table_of_keys = setting.type.json_schema["items"]
            for name, schema in table_of_keys["properties"].items():
                needed = " (needed)" if name in table_of_keys.get("required", ()) else ""
                lines += [".TP", f".B {escaped(name)}{needed}", filled(schema["description"])]
    lines.append('.SH "VARIABLES ONLY"')
    for setting in SETTINGS:
        if not setting.key:
            lines += [".TP", f".B {escaped(setting.env)}", filled(setting.help)]
    return [*lines, '.SH "SEE ALSO"', ".BR rmpa (1),", ".BR rmpa-config (1)"]


def name_section(name: str, text: str) -> list[str]:
    """The section that ``apropos`` reads."""
    return [".SH NAME", f"{escaped(name)} \\- {filled(text.partition(chr(10) * 2)[0]).rstrip('.')}"]


def synopsis(command: click.Command, ctx: click.Context) -> str:
    """A command's words and what may follow."""
    pieces = " ".join(command.collect_usage_pieces(ctx))
    return f"\\fB{escaped(ctx.command_path)}\\fR {escaped(pieces)}".rstrip()


def options(command: click.Command, ctx: click.Context) -> list[str]:
    """Each option and what it does."""
    lines: list[str] = []
    for parameter in command.get_params(ctx):
        # rmpa(1) says --help for all of them; a synopsis has the arguments.
        record = parameter.get_help_record(ctx)
        if record is not None and record[1] and (parameter.name != "help" or ctx.parent is None):
            tag = re.sub(r"(?<![\w-])(--?[\w-]+)", lambda option: f"\\fB{escaped(option[0])}\\fR", record[0])
            lines += [".TP", escaped_but_fonts(tag), filled(record[1])]
    return lines


def prose(text: str | None) -> list[str]:
    """Paragraphs of a help text or epilog: sentences are filled, indented lines are examples or stand as they are."""
    lines: list[str] = []
    for paragraph in (text or "").replace("\b", "").strip("\n").split("\n\n"):
        sentences: list[str] = []
        examples: list[str] = []
        for line in paragraph.strip("\n").splitlines():
            (examples if line.startswith(" ") and sentences else sentences).append(line)
        if sentences:
            lines += [".PP", filled(" ".join(" ".join(sentences).split()))]
        for example in examples:
            match = EXAMPLE.fullmatch(example.strip())
            assert match is not None
            lines += [".TP", f".B {escaped(match[1] or match[3])}", filled(match[2]) if match[2] else "\\&"]
    return lines


def filled(text: str) -> str:
    """One line of text that ``man`` fills; what stands between backquotes is bold."""
    parts = re.split(r"`([^`]+)`", " ".join(text.split()))
    return "".join(f"\\fB{escaped(part)}\\fR" if number % 2 else escaped(part) for number, part in enumerate(parts))


def escaped_but_fonts(text: str) -> str:
    """``escaped``, for a text whose options are bold already."""
    return "".join(p if p.startswith("\\fB") else escaped(p) for p in re.split(r"(\\fB.*?\\fR)", text))


def escaped(text: str) -> str:
    """A text as roff takes it literally, its hyphens those of the keyboard."""
    for mark, name in {
        "\\": r"\(rs",
        "-": r"\-",
        "'": r"\(aq",
        "`": r"\(ga",
        "^": r"\(ha",
        "~": r"\(ti",
        '"': r"\(dq",
    }.items():
        text = text.replace(mark, name)
    return f"\\&{text}" if text.startswith(".") else text
