"""The guide and the README: recipes run, commands, addresses, files and terms exist."""

import re
from pathlib import Path

import pytest
from starlette.routing import Match

from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.sandbox import run_query
from spheremark.web.glossary import glossary, term
from tests.surveyed import fill

ROOT = Path(__file__).parents[1]
GUIDE = ROOT / "web/guide"
PAGES = sorted(GUIDE.glob("*.md"))
TEXTS = [ROOT / "README.md", *PAGES]
RECIPES = re.findall(r"## (.+?)\n.*?```sql\n(.*?)```", (GUIDE / "sql.md").read_text(), re.S)
COMMANDS = [
    (page.name, line)
    for page in TEXTS
    for line in re.findall(
        r"(?:^|`)(spheremark (?!takes|finds|$)[a-z].*?)(?:`|#|$)", page.read_text(), re.M
    )
]
ADDRESSES = sorted(
    {
        (page.name, address)
        for page in TEXTS
        for address in re.findall(
            r"(?:http://127\.0\.0\.1:8000|`(?:GET |POST |PUT |DELETE )?)(/[\w/.-]*)",
            page.read_text(),
        )
        if address != "/tf_static"  # a topic
    }
)
FILES = re.findall(
    r"`((?:pipelines|storage|web|service|tests)/[\w/.]+)`",
    "".join((ROOT / name).read_text() for name in ("README.md", "CONTRIBUTING.md")),
)


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
        part
        for part in reference.split("\n### ")
        if part.startswith((f"`spheremark {words[1]}`", f"`spheremark {' '.join(words[1:3])}`"))
    )
    for option in (word for word in words if word.startswith("-")):
        assert option in command, f"{page}: {line}"


@pytest.fixture(scope="module")
def routes():
    return create_app(Settings()).routes


@pytest.mark.parametrize(("page", "address"), ADDRESSES)
def test_each_address_has_a_route(routes, page, address):
    scope = {"type": "http", "method": "GET", "path": address, "headers": []}
    assert any(route.matches(scope)[0] != Match.NONE for route in routes), f"{page}: {address}"


@pytest.mark.parametrize("name", [name for name in FILES if "NAME" not in name])
def test_each_file_that_is_named_exists(name):
    assert (ROOT / name).exists()


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
