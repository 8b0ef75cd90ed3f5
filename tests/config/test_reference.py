"""What follows from the declarations of the settings: documentation, JSON Schema, options of ``rmpa up``."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

import rmpa
from rmpa.cli.agent import up
from rmpa.cli.gateway import gateway
from rmpa.cli.main import cli
from rmpa.config.read import load_settings
from rmpa.config.settings import SETTINGS, TABLES, json_schema, json_value, schema_text
from rmpa.config.values import Multicast
from rmpa.core.errors import ConfigError
from rmpa.resource.description import resource_schema
from tests.core.example import EXAMPLE, uncommented

# Options of ``rmpa up`` about what a gateway has not: a core of its nodes, a page.
NOT_OF_A_GATEWAY = {"--core", "--master", "--keep", "--web", "--no-web"}
DOCS = Path(__file__).parents[2] / "docs"
SRC = Path(rmpa.__path__[0])
# Limits of messages between agents of this release, and of what the command line asks: errors of broken programs.
BETWEEN_AGENTS = re.compile(
    r"""SOCK_DIAG_|DATA_PAYLOAD_|CONTROL_|KEY_|BEACON_|RECONCILE_|TCPROS_MESSAGE_|CLOCK_|DOCUMENT_|ADVERTISEMENT_
    |ASK_BYTES_|DIRECT_BREAKS_|INSTANCE_ID_""",
    re.VERBOSE,
)


@pytest.fixture(scope="module")
def validate() -> Any:
    return pytest.importorskip("fastjsonschema").compile(json_schema())


def test_documentation_is_up_to_date() -> None:
    script = DOCS.parent / "scripts" / "write-reference"
    done = subprocess.run([sys.executable, script, "--check"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_documentation_has_every_setting_and_every_list_of_tables() -> None:
    page = (DOCS / "reference" / "settings.md").read_text()
    for setting in SETTINGS:
        assert (
            setting.title if setting.is_list_of_tables else f"| `{(setting.key or (setting.env,))[-1]}` |"
        ) in page
    assert {".".join(setting.key[:-1]) for setting in SETTINGS if len(setting.key) > 1} == set(TABLES)


def test_a_limit_that_an_error_names_is_on_the_page() -> None:
    """In the ``limits.py`` of its room: such a comment is a row, as ``test_documentation_is_up_to_date`` sees."""
    text = "".join(path.read_text() for path in SRC.rglob("limits.py"))
    on_the_page = set(re.findall(r"^# At it: .*\n(?:#.*\n)*(\w+): Final", text, re.MULTILINE))
    known = set(re.findall(r"^(\w+): Final", text, re.MULTILINE))
    code = "".join(path.read_text() for path in SRC.rglob("*.py"))
    named = set(re.findall(r"\{(?:\w*limits\.)?([A-Z][A-Z\d_]+)|LimitExceeded\(.*limits\.(\w+)", code))
    assert len(on_the_page) > 200
    beside_it = ({name for pair in named for name in pair} & known) - on_the_page
    assert [name for name in beside_it if not BETWEEN_AGENTS.match(name)] == []


def test_a_row_of_a_limit_names_what_there_is() -> None:
    """Each dotted name is a setting, or a counter that the code counts."""
    page = (DOCS / "reference" / "limits.md").read_text()
    code = "".join(path.read_text() for path in SRC.rglob("*.py") if path.name != "limits.py")
    settings = {".".join(setting.key) for setting in SETTINGS}
    named = set(re.findall(r"`([a-z_]+(?:\.[a-z_]+)+)`", page))
    assert {name for name in settings if name.startswith("limits.")} <= named
    assert [name for name in named - settings if not re.search(rf'[".]{name.rpartition(".")[2]}"', code)] == []


def test_no_two_settings_share_a_name() -> None:
    options = [(s.command, s.option_name) for s in SETTINGS if s.option]  # one --insecure of up, one of gateway
    for names in ([s.key for s in SETTINGS], [s.env for s in SETTINGS], options):
        given = [name for name in names if name]
        assert len(given) == len(set(given))


def test_every_default_can_be_read_again() -> None:
    for setting in SETTINGS:
        if setting.default not in ("", (), None):
            assert setting.type.read(json_value(setting.default)) == setting.default, setting.name


def test_up_has_an_option_for_each_setting_that_declares_one() -> None:
    of_up = {part for s in SETTINGS if s.option and s.command == "up" for part in s.option.split("/")}
    of_gateway = {part for s in SETTINGS if s.option and s.command == "gateway" for part in s.option.split("/")}
    assert _options(up) == {"--config", "-q", "--quiet"} | of_up
    assert _options(gateway) == {"--config"} | of_gateway | of_up - NOT_OF_A_GATEWAY


def _options(command: click.Command) -> set[str]:
    return {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}


def test_schema_accepts_the_example_file(validate: Any) -> None:
    validate(tomllib.loads(EXAMPLE.read_text()))
    validate(tomllib.loads(uncommented(EXAMPLE.read_text())))


def test_schema_accepts_the_files_of_the_documentation(validate: Any) -> None:
    blocks = [
        block.partition("```")[0] for page in DOCS.rglob("*.md") for block in page.read_text().split("```toml\n")[1:]
    ]
    assert len(blocks) > 20
    resource = pytest.importorskip("fastjsonschema").compile(resource_schema())
    parts = re.compile(r"(?m)^\[(node|profile|parameter|attribute|output|input|context|alarm|ask|adaptation|start)\b")
    for block in blocks:
        try:
            if parts.search(block):
                resource({"role": "sensing", "profile": {}, **tomllib.loads(block)})
            else:
                validate(tomllib.loads(block))
        except Exception as error:
            raise AssertionError(block) from error


@pytest.mark.parametrize(
    "text",
    [
        "domian = 3",
        "domain = 233",
        "core = 5",
        "[core]\nprot = 1",
        "[core]\nmode = 'extern'",
        "[core]\nport = 0",
        "name = 'robot-1'",
        "[log]\nlevel = 'wran'",
        "[bridge]\nallow = '/a'",
        "[bridge]\nallow = ['/a', '/a']",
        "[discovery]\nmulticast = 5",
        "[[contract]]\ntopics = ['/a']\ndept = 1",
        "[[contract]]\ntopics = []",
        "[[contract]]\ntopics = ['/a']\nreliability = 'reliabel'",
        "[[peer]]\nprefix = '/a'",
        "[[peer]]\nname = 'a'\nremap_in = {'/a' = 1}",
        "[[service]]\ntimeout = 1",
        "[[param]]\nkey = '/a'",
        "[param]\nkey = '/a'",
        "[gateway]\nsites = 'a'",
        "[gateway]\nconnect = ['http://a:1']",
        "[gateway.ros2]\nenable = true",
        "[gateway.ros2]\ndistribution = 'jazy'",
        "[gateway]\nros2 = true",
        "[gateway]\nrank = 1000",
        "[[gateway.rule]]\nnames = []",
        "[gateway.rule]\nrate = 2",
        "[[gateway.rule]]\ncrossing = 'inn'",
    ],
)
def test_schema_refuses_what_the_agent_refuses(validate: Any, tmp_path: Path, text: str) -> None:
    (tmp_path / "rmpa.toml").write_text(text)
    with pytest.raises(ConfigError):
        load_settings({}, {}, host_name="a", cwd=tmp_path)
    with pytest.raises(ValueError, match="data"):
        validate(tomllib.loads(text))


def test_schema_has_defaults_and_descriptions_for_editors() -> None:
    core = json_schema()["properties"]["core"]["properties"]["port"]
    assert core["default"] == 11311
    assert core["description"] == "The ROS core's port."
    assert (core["minimum"], core["maximum"]) == (1, 65535)


def test_config_show_says_where_each_setting_comes_from(tmp_path: Path) -> None:
    file = tmp_path / "rmpa.toml"
    file.write_text('domain = 3\n[discovery]\nmulticast = false\n[[contract]]\ntopics = ["/a"]\ndepth = 1\n')
    run = CliRunner(env={"RMPA_PORT": "40001"}).invoke(cli, ["config", "show", "--config", str(file)])
    rows = {row.split()[0]: row.split() for row in run.output.splitlines()}
    assert rows["domain"] == ["domain", "3", f"{file}:1"]
    assert rows["discovery.multicast"][1:] == ["false", f"{file}:3"]
    assert rows["[[contract]]"][1:] == ["1", "table", f"{file}:4"]
    assert rows["mesh.port"][1:] == ["40001", "RMPA_PORT"]
    assert rows["core.port"][1:] == ["11311", "default"]


def test_config_show_prints_one_json_document(tmp_path: Path) -> None:
    import msgspec

    (tmp_path / "rmpa.toml").write_text('[[service]]\nnames = ["/a"]\ntimeout = 2\n')
    run = CliRunner().invoke(cli, ["config", "show", "--json", "--config", str(tmp_path / "rmpa.toml")])
    found = {entry["name"]: entry for entry in msgspec.json.decode(run.output)["settings"]}
    assert found["[[service]]"]["value"] == [{"names": ["/a"], "timeout": 2.0}]
    assert found["discovery.multicast"] == {
        "name": "discovery.multicast",
        "value": str(Multicast()),
        "from": "default",
    }


def test_config_schema_prints_the_schema() -> None:
    assert CliRunner().invoke(cli, ["config", "schema"]).output == schema_text()
