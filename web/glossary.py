"""The words of the product and what they mean, for pages and the guide: ``glossary.json``."""

from __future__ import annotations

import json
from functools import cache
from importlib import resources

from markupsafe import Markup

_OTHER_FORMS = {
    "sigmas": "sigma",
    "centres": "centre",
    "marks": "mark",
    "markers": "marker",
    "stations": "station",
    "stops": "stop",
    "detectable bias [mm]": "detectable bias",
    "mdb": "detectable bias",
    "bearing": "95 % ellipse",
}


@cache
def glossary() -> dict[str, str]:
    """Return the meaning of each word, in the order of the alphabet."""
    text = resources.files("spheremark.web").joinpath("glossary.json").read_text("utf-8")
    found: dict[str, str] = json.loads(text)
    return found


def anchor(word: str) -> str:
    """Return the anchor of a word in the glossary's page."""
    return "".join(letter if letter.isalnum() else "-" for letter in word.lower())


def term(text: str) -> str | Markup:
    """Return a text as a link whose hint is its meaning; a text that is no word stays as it is."""
    word = text.lower()
    word = _OTHER_FORMS.get(word, word)
    if word not in glossary():  # the first word counts: "Sigma, 3-D", "Error of height"
        word = word.replace(",", " ").partition(" ")[0]
        word = _OTHER_FORMS.get(word, word)
    if word not in glossary():
        return text
    link = Markup('<a class="term" href="/glossary#{}" title="{}">{}</a>')
    return link.format(anchor(word), glossary()[word], text)
