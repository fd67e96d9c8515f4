"""Tables as people write them."""

import numpy as np
import pytest

from stitch.errors import InputError
from stitch.plugins.intake.pose_tables import parse_number_table, read_number_table

ROWS = [[111.5, -331.25, 317.0, -2.5, 0.125, 3.0], [114.0, -358.5, 360.75, -2.75, 0.25, -3.0]]


def written(row, separator, comma):
    cells = [str(x).replace(".", ",") if comma else str(x) for x in row]
    return separator.join(cells)


@pytest.mark.parametrize("end", ["", "trailing"])
@pytest.mark.parametrize("header", [None, "x y z rx ry rz", "# x y z rx ry rz"])
@pytest.mark.parametrize(
    ("separator", "comma"),
    [(",", False), (", ", False), (";", False), (";", True), ("\t", True), ("   ", False), (" ", True), (" | ", True)],
)
def test_any_separator_decimal_mark_and_header(tmp_path, separator, comma, header, end):
    lines = [written(row, separator, comma) + separator.strip() * bool(end) for row in ROWS]
    if header:
        mark, names = ("# ", header[2:]) if header[0] == "#" else ("", header)
        lines = [mark + separator.join(names.split()), *lines]
    (tmp_path / "t.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    table = read_number_table(tmp_path / "t.txt")
    assert np.array_equal(table.numbers, ROWS)
    assert table.header == (("x", "y", "z", "rx", "ry", "rz") if header else None)


def test_a_number_in_the_title_and_blanks_in_names_leave_the_tabs(tmp_path):
    (tmp_path / "t.txt").write_text(
        "Roboterposen Zelle 4\n\ncloud\tx\ty\tz\nscan 0.asc\t1.5\t2\t3\nscan 1.asc\t2\t3\t4\n"
    )
    table = read_number_table(tmp_path / "t.txt")
    assert table.header == ("x", "y", "z") and table.numbers.tolist() == [[1.5, 2, 3], [2, 3, 4]]
    assert table.labels == (("scan 0.asc",), ("scan 1.asc",))


def test_a_table_in_markdown_and_matrices_in_one_row(tmp_path):
    (tmp_path / "t.md").write_text("| scan | x | y |\n|:---|---:|---:|\n| a.ply | 1.5 | -2 |\n| b.ply | 2.5 | 3 |\n")
    table = read_number_table(tmp_path / "t.md")
    assert table.header == ("x", "y") and table.numbers.tolist() == [[1.5, -2], [2.5, 3]]
    assert [row[-1] for row in table.labels] == ["a.ply", "b.ply"]
    rows = "[1.5, 2.5, 3.5, 4.5; 0, 1.5, 0, 9; 0.5, 0, 1, -7; 0, 0, 0, 1]"
    (tmp_path / "t.txt").write_text(f"T0 = {rows};\nT1 = {rows};\n")
    expected = [1.5, 2.5, 3.5, 4.5, 0, 1.5, 0, 9, 0.5, 0, 1, -7, 0, 0, 0, 1]
    assert read_number_table(tmp_path / "t.txt").numbers.tolist() == [expected] * 2


def test_brackets_comments_degree_signs_and_names_of_views(tmp_path):
    text = "// made by hand\nview-1, [1.5, 2, 3], 10°, a.ply\n\nview-2, [2.5, 2, 3], -20°, b.ply\n"
    (tmp_path / "t.txt").write_text(text, encoding="utf-8")
    table = read_number_table(tmp_path / "t.txt")
    assert table.numbers.tolist() == [[1.5, 2, 3, 10], [2.5, 2, 3, -20]]
    assert table.labels == (("view-1", "a.ply"), ("view-2", "b.ply")) and table.lines == (2, 4)


def test_what_a_spreadsheet_writes_above_its_table_is_passed_over(tmp_path):
    lines = [
        "\ufeffRobot poses, cell 7, 2026;;;;",
        ";;;;",
        "Point;X [in];Y;Z;A",
        "P1;1,5;2;3;4",
        "P2;2,5;2;3;4",
        ";;;;",
    ]
    (tmp_path / "t.csv").write_text("\r\n".join(lines), encoding="utf-8")
    table = read_number_table(tmp_path / "t.csv")
    assert table.numbers.tolist() == [[1.5, 2, 3, 4], [2.5, 2, 3, 4]] and table.lines == (4, 5)
    assert table.header is not None and [name.split()[0] for name in table.header] == ["X", "Y", "Z", "A"]
    assert table.labels == (("P1",), ("P2",)) and "1 line of words" in table.words


@pytest.mark.parametrize("units", ["", "[mm];;;;[deg];\n"])
def test_remarks_in_few_rows_and_units_in_a_row_of_their_own(tmp_path, units):
    text = f"x;y;z;a;b;Remark\n{units}1,5;2;3;4;5;\n2,5;2;3;4;5;cold\n3,5;2;3;4;5;\n"
    (tmp_path / "t.csv").write_text(text, encoding="utf-8")
    table = read_number_table(tmp_path / "t.csv")
    assert table.numbers[:, 0].tolist() == [1.5, 2.5, 3.5] and table.numbers.shape == (3, 5)
    assert table.header == (("x [mm]", "y", "z", "a", "b [deg]") if units else ("x", "y", "z", "a", "b"))
    assert table.labels == (("",), ("cold",), ("",))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "no rows"),
        ("just words\nand more\n", "no rows"),
        ("1,2,3\n4,5\n6,7,8\n", "line 2: 2 cells"),
        # A pose that lacks numbers is no title.
        ("P1,1,2\nP2,4,5,6\nP3,6,7,8\n", "line 1: 3 cells"),
        ("1,2,3\n4,x5,6\n7,8,9\n", "line 2: 'x5'"),
        ("1,2,3\n4,1e99,6\n7,8,9\n", "line 2"),
        # Thousands, or a little more than one?
        ("1269,5;2;3\n1.269;5;6\n", "line 2: '1.269' has a point"),
    ],
)
def test_what_is_no_table_is_refused_with_its_line(tmp_path, text, told):
    (tmp_path / "t.csv").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=told):
        read_number_table(tmp_path / "t.csv")


def test_remarks_in_some_rows_and_units_in_a_row_of_their_own(tmp_path):
    lines = [
        "Messreihe 3;;;;;;;",
        "",
        "Datei;X;Y;Z;Rx;Ry;Rz;Bemerkung",
        ";mm;mm;mm;[deg];deg;deg;",
        "a.ply;1,5;2;3;4;5;6;",
        "b.ply;2,5;2;3;4;5;6;Neustart",
        ";;;;;;;",
    ]
    (tmp_path / "t.csv").write_text("\r\n".join(lines), encoding="cp1252")
    table = read_number_table(tmp_path / "t.csv")
    assert table.header == ("X [mm]", "Y [mm]", "Z [mm]", "Rx [deg]", "Ry [deg]", "Rz [deg]")
    assert table.numbers.tolist() == [[1.5, 2, 3, 4, 5, 6], [2.5, 2, 3, 4, 5, 6]]
    assert table.labels == (("a.ply", ""), ("b.ply", "Neustart")) and table.lines == (5, 6)


def test_a_number_that_lacks_at_the_end_is_no_remark(tmp_path):
    (tmp_path / "t.csv").write_text("x;y;z\n1;2;3\n4;5;\n7;8;9\n", encoding="utf-8")
    with pytest.raises(InputError, match="line 3: '' is no number"):
        read_number_table(tmp_path / "t.csv")


def test_a_row_whose_every_line_is_marked_has_its_number(tmp_path):
    rows = "".join(f"#{i} ({i}.5, 2.5, -3.5) (0.1, 0.2, 0.3, 0.{i}9)\n" for i in range(1, 4))
    table = parse_number_table(tmp_path / "poses.txt", rows)
    np.testing.assert_allclose(table.numbers[1], [2.5, 2.5, -3.5, 0.1, 0.2, 0.3, 0.29])
    assert [labels[0] for labels in table.labels] == ["#1", "#2", "#3"]


def test_a_name_alone_between_rows_of_numbers_has_none(tmp_path):
    text = "Messung vom Montag,,,\nname,x,y,z\na,1,2,3\nb,,,\nc,4,5,6\n"
    table = parse_number_table(tmp_path / "poses.csv", text)
    np.testing.assert_array_equal(table.numbers, [[1, 2, 3], [np.nan] * 3, [4, 5, 6]])
    assert [labels[0] for labels in table.labels] == ["a", "b", "c"]
