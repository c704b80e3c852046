import numpy as np
import pytest

from spheremark.pipelines.errors import InputError
from spheremark.web.pages.filters import Filters

TABLE = {
    "stop": np.array(["lane1-stop1", "lane1-stop2", "lane2-stop1"], dtype=object),
    "fit_method": np.array(["along_beam", "paper", "paper"], dtype=object),
    "status": np.array(["ok", "weak", "ok"], dtype=object),
    "range_m": np.array([3.0, 7.0, 12.0]),
}


def kept(**query):
    filters = Filters.from_query({name: [value] for name, value in query.items()})
    return filters.apply(TABLE)["range_m"].tolist()


def test_no_filter_keeps_every_row():
    assert kept() == [3.0, 7.0, 12.0]


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ({"method": "paper"}, [7.0, 12.0]),
        ({"lane": "lane1"}, [3.0, 7.0]),
        ({"stop": "lane2-stop1"}, [12.0]),
        ({"status": "weak"}, [7.0]),
        ({"range_from_m": "3.0", "range_to_m": "7"}, [3.0, 7.0]),
        ({"method": "paper", "range_to_m": "10"}, [7.0]),
    ],
)
def test_each_filter_keeps_what_it_names(query, expected):
    assert kept(**query) == expected


def test_a_filter_does_not_restrict_a_table_without_its_column():
    rows = Filters(range_from_m=5.0).apply({"stop": TABLE["stop"]})
    assert len(rows["stop"]) == 3


def test_filters_read_back_from_their_own_query():
    from urllib.parse import parse_qs

    filters = Filters(
        methods=("paper", "along_beam"),
        lane="lane 1",
        range_from_m=2.5,
        status="ok",
        is_log=True,
        n_marks=3,
        resection="paper",
    )
    assert Filters.from_query(parse_qs(filters.query())) == filters


@pytest.mark.parametrize(
    "query",
    [
        {"range_from_m": "near"},
        {"range_to_m": "inf"},
        {"axes": "square"},
        {"marks": "4"},
        {"resection": "magic"},
    ],
)
def test_what_cannot_be_read_is_refused_by_name(query):
    with pytest.raises(InputError, match=next(iter(query))):
        Filters.from_query({name: [value] for name, value in query.items()})
