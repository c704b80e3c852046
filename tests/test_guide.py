"""The guide: its recipes run, its commands exist, its links lead somewhere, its terms are known."""

import re
from pathlib import Path

import pytest

from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.sandbox import run_query
from spheremark.web.glossary import glossary, term
from tests.surveyed import fill

ROOT = Path(__file__).parents[1]
GUIDE = ROOT / "web/guide"
PAGES = sorted(GUIDE.glob("*.md"))
RECIPES = re.findall(r"## (.+?)\n.*?```sql\n(.*?)```", (GUIDE / "sql.md").read_text(), re.S)
COMMANDS = [
    (page.name, line)
    for page in PAGES
    for line in re.findall(r"(?:^|`)(spheremark (?!takes)[a-z].*?)(?:`|$)", page.read_text(), re.M)
]


@pytest.fixture(scope="module")
def snapshot(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    with Catalogue(folder / "a.duckdb", snapshots=folder / "snapshots") as catalogue:
        fill(catalogue, folder / "clouds", "quarry", n_stops=2)
        yield catalogue.snapshot()


@pytest.mark.parametrize(("title", "sql"), RECIPES, ids=[title for title, _ in RECIPES])
def test_each_recipe_runs(snapshot, title, sql):
    found = run_query(snapshot, sql, Settings().query_limits)
    assert found.columns
    assert found.rows or "disturb" in title or "miss" in title  # there is no network, none misses


@pytest.mark.parametrize(("page", "line"), COMMANDS, ids=[line for _, line in COMMANDS])
def test_each_command_and_its_options_are_in_the_reference(page, line):
    reference = (ROOT / "REFERENCE.md").read_text()
    words = line.split()
    command = next(
        part for part in reference.split("\n### ") if part.startswith(f"`spheremark {words[1]}`")
    )
    for option in (word for word in words if word.startswith("-")):
        assert option in command, f"{page}: {line}"


def test_links_between_pages_lead_to_pages_that_there_are():
    made = {"made/glossary.md", "made/commands.md", "made/conventions.md"}
    known = {page.name for page in PAGES} | made
    for page in PAGES:
        for link in re.findall(r"\]\(([\w/-]+\.md)", page.read_text()):
            assert link in known, f"{page.name}: {link}"


def test_every_page_is_in_the_list_of_pages():
    listed = re.findall(r"^[\w/-]+$", (GUIDE / "index.md").read_text(), re.M)
    assert {page.stem for page in PAGES} - {"index"} <= set(listed)


def test_a_word_of_the_glossary_is_a_link_with_its_meaning():
    assert f'title="{glossary()["w"]}"' in term("w")
    assert 'href="/glossary#95---ellipse"' in term("Bearing")
    assert term("Recording") == "Recording"
