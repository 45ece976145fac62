"""README and docs cannot rot quietly: commands exist, options exist, every key is described, links lead somewhere."""

import re
import tomllib
from pathlib import Path

import pytest
import typer.main

from demobench.cli import app
from pipeline import config
from pipeline.settings import SETTINGS

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted(ROOT.glob("pipeline/embedded/*/README.md"))]
COMMAND = re.compile(r"^\s*(?:\$ )?(?:\.venv/bin/)?demobench ([^\n`|#]*)", re.MULTILINE)
MAKE = re.compile(r"\bmake ([a-z-]+)")


def code_of(page: Path) -> str:
    """Everything in fenced blocks and backticks."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"```[a-z]*\n(.*?)```", text, re.DOTALL)
    inline = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    return "\n".join([*blocks, *inline])


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_commands_and_options_exist(page):
    commands = typer.main.get_command(app).commands
    for line in COMMAND.findall(code_of(page)):
        words = line.split()
        if not words or words[0].startswith("-"):
            continue
        assert words[0] in commands, f"{page.name} shows `demobench {words[0]}`, which does not exist"
        command = commands[words[0]]
        for inner in words[1:]:
            if inner in getattr(command, "commands", {}):
                command = command.commands[inner]
        known = {name for parameter in command.params for name in parameter.opts} | {"--help", "--debug"}
        used = {word.split("=")[0] for word in words if word.startswith("--")}
        assert used <= known, f"{page.name} shows {sorted(used - known)} with `demobench {words[0]}`"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_make_targets_exist(page):
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(MAKE.findall(code_of(page))) <= targets


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for link in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
        if "://" not in link:
            assert (page.parent / link).exists(), f"{page.name} links to {link}, which is not there"


def test_every_key_of_the_configuration_is_described():
    text = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
    blocks = {
        "store": config.StoreConfig,
        "tracking": config.TrackingConfig,
        "benchmark": config.BenchmarkConfig,
        "datasets": config.DatasetConfig,
        "policies": config.PolicyConfig,
        "schedule": config.ScheduleConfig,
        "notify": config.NotifyConfig,
    }
    assert set(blocks) == set(config.Config.model_fields)
    for name, model in blocks.items():
        section = re.search(rf"## `\[{name}[^\n]*\n(.*?)(?=\n## |\Z)", text, re.DOTALL)
        assert section, f"no section for [{name}]"
        for key in model.model_fields:
            assert f"| `{key}` |" in section[1], f"docs/configuration.md does not describe {key} of [{name}]"


def test_every_method_and_its_settings_are_described():
    text = (ROOT / "docs" / "policies.md").read_text(encoding="utf-8")
    for method, kind in SETTINGS.items():
        assert f"| `{method}` |" in text, f"docs/policies.md does not describe the method {method}"
        rows = [line for line in text.splitlines() if line.startswith("| `")]
        for setting in kind.model_fields:
            assert any(f"`{setting}`" in line.split("|")[1] for line in rows), f"{setting} of {method} is not described"


def test_the_example_of_policies_is_a_configuration():
    text = (ROOT / "docs" / "policies.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    recipe = config.parse_config(tomllib.loads(block), "docs/policies.md").policies["recipe"]
    expected = {"history", "actions", "features", "symmetry", "noise", "hindsight", "cpu_seconds"}
    assert set(recipe.given) == expected


def test_the_readme_names_its_two_commands():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "make demo" in text
    assert "make test" in text
