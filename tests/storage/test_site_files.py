"""Control marks, truth and rigs as files."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from spheremark.pipelines.errors import ControlError, NotFoundError, RigError, TruthError
from spheremark.pipelines.geometry import rigid, rot_x, rot_z
from spheremark.pipelines.model import ControlMarks, StopTruth, Truth
from spheremark.pipelines.scan.rigs import rig_to_mapping, tilted_vlp16
from spheremark.storage.imports.survey_files import (
    CONTROL_COLUMNS,
    ControlLayout,
    format_control,
    format_rig,
    format_truth,
    parse_control,
    parse_rig,
    parse_truth,
    read_control,
    read_rig,
    read_truth,
)

P = np.array([[1.0, -2.5, 0.8], [1e5 / 3, 2.0, -0.1]])


def marks(names=("M1", "M2"), sigmas=((0.001, 0.002, 0.003), (0.0, 0.0, 0.0))):
    return ControlMarks(
        names=tuple(names),
        p_site=P.copy(),
        cov_p_site=np.array([np.diag(np.square(row)) for row in sigmas]),
    )


def test_control_marks_come_back_as_they_were_written(tmp_path):
    (tmp_path / "control.csv").write_text(format_control(marks()))
    found = read_control(tmp_path / "control.csv")
    assert (tmp_path / "control.csv").read_text().splitlines()[0] == ",".join(CONTROL_COLUMNS)
    assert found.names == ("M1", "M2")
    assert_array_equal(found.p_site, P)
    assert_allclose(found.cov_p_site, marks().cov_p_site, rtol=1e-12, atol=0)


@given(st.text(alphabet=' #,;"a1é', min_size=1, max_size=8).map(str.strip).filter(bool))
def test_any_name_comes_back(name):
    assert parse_control(format_control(marks((name, "other mark")))).names[0] == name


@pytest.mark.parametrize(
    "text",
    [
        "mark,x_m,y_m,z_m\nA,1,2,3\n",
        "\ufeffName;E;N;Height\r\n# by total station\r\nA;1;2;3\r\n\r\n",
        "point\teasting_m\tnorthing_m\televation_m\nA\t1\t2\t3\n",
        "Z,Y,X,ID\n3,2,1,A # near the rock\n",
        "A,1,2,3\n",
        " label , x , y , up \n A , 1.0 , 2e0 , 3 ",
    ],
)
def test_the_usual_spellings_of_a_table_are_read(text):
    found = parse_control(text)
    assert found.names == ("A",)
    assert_array_equal(found.p_site, [[1, 2, 3]])
    assert_array_equal(found.cov_p_site, np.zeros((1, 3, 3)))


@pytest.mark.parametrize(
    ("text", "sigmas"),
    [
        ("mark,x,y,z,sigma_m\nA,1,2,3,0.01\n", [0.01, 0.01, 0.01]),
        ("mark,x,y,z,sigma_z_m,sigma_x_m,sigma_y_m\nA,1,2,3,0.3,0.1,0.2\n", [0.1, 0.2, 0.3]),
        ("A,1,2,3,0.1,0.2,0.3\n", [0.1, 0.2, 0.3]),
    ],
)
def test_standard_deviations_are_read(text, sigmas):
    assert_allclose(np.diag(parse_control(text).cov_p_site[0]), np.square(sigmas), rtol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("# nothing\n", "is empty"),
        ("mark,x_m,y_m,z_m\n", "no marks"),
        ("mark,x_m,y_m\nA,1,2\n", "lacks z_m"),
        ("mark,x_m,y_m,z_m,colour\nA,1,2,3,red\n", "'colour'"),
        ("mark,x,x_m,y,z\nA,1,1,2,3\n", "x_m twice"),
        ("mark,x,y,z,sigma_x\nA,1,2,3,1\n", "all three"),
        ("mark,x,y,z\nA,1,2\n", "Line 2 .* has 3 values and must have 4"),
        ("mark,x,y,z\nA,1,2,3\nB,1,two,3\n", "Line 3, column y_m .* 'two'"),
        ("mark,x,y,z\nA,1,2,nan\n", "Line 2, column z_m"),
        ("mark,x,y,z\nA,1,2,inf\n", "Line 2, column z_m"),
        ("A,1,2,nan\n", "Line 1, column z_m"),
        ("mark,x,y,z\n,1,2,3\n", "without a name"),
        ("mark,x,y,z\nA,1,2,3\nA,4,5,6\n", "Lines 2 and 3 .* 'A'"),
        ("mark,x,y,z\nA,1,2,3\nC,9,9,9\nB,1,2.003,3.004\n", "Lines 2 and 4 .* 5.0 mm apart"),
        ("mark,x,y,z,sigma\nA,1,2,3,-1\n", "negative"),
        ("mark,x,y,z\n" + "".join(f"{k},{k},0,0\n" for k in range(10_001)), "more than 10,000"),
        ("x" * 4_000_001, "characters"),
        (
            "mark,x,y,z\nA,1,2,3\n" + "B" * 140_000 + ",4,5,6",
            "Line 3 .* 131,072 characters; a name",
        ),
        ("B" * 140_000 + ",4,5,6", "Line 1 .* 131,072 characters"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused(text, message):
    with pytest.raises(ControlError, match=message):
        parse_control(text)


def test_ten_thousand_marks_are_read():
    text = "".join(f"m{k},{k % 100},{k // 100},0\n" for k in range(10_000))
    assert len(parse_control(text).names) == 10_000


def truth():
    return Truth(
        marks=marks(sigmas=np.zeros((2, 3))),
        stops=(StopTruth(name="S1", T_site_base=rigid(rot_z(0.3) @ rot_x(0.02), (1, 2, 3))),),
        rig=tilted_vlp16("true", (0.05, -0.01)),
        about={"seed": 7, "scenario": "paper-field"},
    )


def test_truth_comes_back_as_it_was_written(tmp_path):
    (tmp_path / "truth.json").write_text(format_truth(truth()))
    found = read_truth(tmp_path / "truth.json")
    assert found.marks.names == ("M1", "M2")
    assert_array_equal(found.marks.p_site, P)
    assert_array_equal(found.stops[0].T_site_base, truth().stops[0].T_site_base)
    assert rig_to_mapping(found.rig) == rig_to_mapping(truth().rig)
    assert found.about == {"seed": 7, "scenario": "paper-field"}


def changed(**changes):
    return json.dumps(json.loads(format_truth(truth())) | changes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mark,x", "is not JSON"),
        ("[1]", "holds a list"),
        ("{}", "format None"),
        (changed(format="spheremark-truth/9"), "spheremark-truth/9"),
        (changed(marks=[{"name": "A"}]), "position_m"),
        (changed(marks=[{"name": "A", "position_m": [1, 2]}]), "three numbers"),
        (changed(marks=[{"name": "A", "position_m": [1, 2, 3]}] * 2), "two marks"),
        (changed(marks=None), "expected marks"),
        (changed(marks=[{"name": "A", "position_m": [1, 2, 10**400]}]), "beyond 1.8e.308"),
        (changed(about={"\ud800": 1}), "half of a surrogate pair"),
        (changed(about="long" * 20 + "\udfff"), r"'\\udfff'"),
        ("[" * 100_000 + "]" * 100_000, "more than 32 levels"),
        (
            changed(
                stops=[
                    {"name": "S", "position_m": [0, 0, 0], "rotation_site_base": [[1, 2], [3, 4]]}
                ]
            ),
            "not a rotation",
        ),
        (
            changed(
                stops=[
                    {
                        "name": "S",
                        "position_m": [0, 0, 0],
                        "rotation_site_base": np.diag([1, 1, -1]).tolist(),
                    }
                ]
            ),
            "reflection",
        ),
    ],
)
def test_a_truth_that_cannot_be_used_is_refused(text, message):
    with pytest.raises(TruthError, match=message):
        parse_truth(text)


def test_a_truth_may_have_no_rig():
    assert parse_truth(changed(rig=None)).rig is None


def test_a_rig_comes_back_as_it_was_written(tmp_path):
    rig = tilted_vlp16("study", (0.05, 0.02))
    (tmp_path / "rig.json").write_text(format_rig(rig))
    assert rig_to_mapping(read_rig(tmp_path / "rig.json")) == rig_to_mapping(rig)
    inside = json.dumps({"rig": json.loads(format_rig(rig)), "sigma_m": 0.1})
    assert rig_to_mapping(parse_rig(inside)) == rig_to_mapping(rig)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not JSON"),
        ("3", "holds a int"),
        ('{"rig": 3}', "must be an object"),
        ("{}", "no T_head_lidar"),
    ],
)
def test_a_rig_that_cannot_be_used_is_refused(text, message):
    with pytest.raises(RigError, match=message):
        parse_rig(text)


def test_a_file_that_is_not_there_is_not_found(tmp_path):
    with pytest.raises(NotFoundError, match="no file"):
        read_control(tmp_path / "none.csv")


def test_a_file_that_is_no_text_is_refused(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"\x89MCAP0\r\n\xff\xfe")
    with pytest.raises(ControlError, match="UTF-8"):
        read_control(tmp_path / "a.csv")


NORTHING_FIRST = np.array([[20.0, 10.0, 3.0]])  # x east, y north, z up of what stands below


@pytest.mark.parametrize(
    ("text", "layout"),
    [
        ("A,10,20,3", ControlLayout(axes="neu")),
        ("A,10,20,-3", ControlLayout(axes="ned")),
        ("mark,x,y,z\nA,10,20,3", ControlLayout(axes="neu")),
        ("mark,x,y,z\nA,10,20,-3", ControlLayout(axes="ned")),
        ("P,N,E,Z,D\nA,10,20,3,red ball", ControlLayout()),
        ("A,10,20,3,red ball", ControlLayout(axes="neu")),
        ("mark,n,e,d\nA,10,20,-3", ControlLayout()),
        ("mark,e,n,h\nA,20000,10000,3000", ControlLayout(unit="mm")),
        ("mark,e,n,h\nA,20,10,1.5", ControlLayout(target_height=1.5)),
        ("mark,e,n,h,th\nA,20,10,1.25,1.75", ControlLayout(target_height=9.0)),
    ],
)
def test_axes_units_and_target_heights_lead_to_the_same_centre(text, layout):
    marks = parse_control(text, layout)
    np.testing.assert_allclose(marks.p_site, NORTHING_FIRST, rtol=0, atol=1e-12)


def test_feet_are_feet_and_those_of_the_us_survey_a_little_longer():
    feet, us = (
        parse_control("A,1000,0,0,0.01,0,0", ControlLayout(unit=unit)) for unit in ("ft", "us-ft")
    )
    assert feet.p_site[0, 0] == pytest.approx(304.8, abs=1e-9)
    assert us.p_site[0, 0] - feet.p_site[0, 0] == pytest.approx(0.0006096, abs=1e-7)
    assert np.sqrt(feet.cov_p_site[0, 0, 0]) == pytest.approx(0.003048, abs=1e-12)


def test_coordinates_of_a_national_grid_may_be_in_millimetres():
    layout = ControlLayout(unit="mm")
    marks = parse_control("A,3500000123,5500000456,120789,1,2,3", layout)
    assert_allclose(marks.p_site, [[3500000.123, 5500000.456, 120.789]], rtol=0, atol=1e-6)
    with pytest.raises(ControlError, match=r"column x_m .* '2e11', that is 2e\+08 m; .* 1e\+08 m"):
        parse_control("A,2e11,0,0", layout)


@pytest.mark.parametrize("text", ["A,10,20,3,0.1,0.2,0.3", "m,x,y,z,sx,sy,sz\nA,10,20,3,.1,.2,.3"])
def test_sigmas_follow_their_axes(text):
    text = text.replace("m,x", "mark,x")
    marks = parse_control(text, ControlLayout(axes="neu"))
    np.testing.assert_allclose(np.sqrt(np.diag(marks.cov_p_site[0])), [0.2, 0.1, 0.3], atol=1e-12)


@pytest.mark.parametrize(
    "wrong", [{"axes": "esu"}, {"unit": "yard"}, {"target_height": float("nan")}]
)
def test_a_layout_that_is_none_is_refused(wrong):
    with pytest.raises(ControlError, match=r"control table|target height"):
        ControlLayout(**wrong)
