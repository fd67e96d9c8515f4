"""Tables as people write them.

A table as a spreadsheet of another country saves it: its letters, its words, its clock, its own order of scans.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.fixtures.raw_folders import Convention, raw_folder, session_poses
from data_synth.write import write_session
from stitch.errors import InputError
from stitch.plugins.intake.clock_times import DAY_FIRST, MONTH_FIRST, clock_times
from stitch.plugins.intake.cloud_pairs import pairings
from stitch.plugins.intake.first_session import first_session
from stitch.plugins.intake.folder_files import find_folder_files
from stitch.plugins.intake.layouts import covariate_columns, possible_layouts
from stitch.plugins.intake.pose_tables import parse_number_table
from stitch.plugins.intake.raw_poses import read_raw_poses
from stitch.plugins.intake.session_draft import write_draft
from stitch.plugins.intake.stated_folder import StatedFolder
from stitch.plugins.intake.table_files import read_any_text
from stitch.session.reading.session_folder import load_session

ROWS = [[111.5, -331.25, 317.0, -2.5, 0.125, 3.0], [114.0, -358.5, 360.75, -2.75, 0.25, -3.0]]


def read_number_table(file):
    return parse_number_table(file, read_any_text(file, "name a table"))


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


@pytest.mark.parametrize("units", ["", "[mm];;;;[deg];\n", "mm;;;;deg;\n"])
def test_remarks_in_few_rows_and_units_in_a_row_of_their_own(tmp_path, units):
    text = f"Messreihe 3;;;;;\n\nx;y;z;a;b;Remark\n{units}1,5;2;3;4;5;\n2,5;2;3;4;5;kühl\n3,5;2;3;4;5;\n;;;;;\n"
    (tmp_path / "t.csv").write_text(text, encoding="cp1252")
    table = read_number_table(tmp_path / "t.csv")
    assert table.numbers[:, 0].tolist() == [1.5, 2.5, 3.5] and table.numbers.shape == (3, 5)
    assert table.header == (("x [mm]", "y", "z", "a", "b [deg]") if units else ("x", "y", "z", "a", "b"))
    assert table.labels == (("",), ("kühl",), ("",))


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


HEADER = (
    "Nr.;Messung;Lage X [m];Lage Y [m];Lage Z [m];Drehung um Z [°];Drehung um Y [°];Drehung um X [°];Uhrzeit;Luft °C"
)
ROWS_SPREADSHEET = ["1;Süd;0,5;-0,25;1;90;0;0;23:58:10;21,5", "2;Nord;0,5;-0,25;2;0;45;0;23:59:10,5;21,6"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
def test_letters_and_words_of_another_country(tmp_path, encoding):
    file = tmp_path / "Posen.csv"
    file.write_bytes("\r\n".join([HEADER, *ROWS_SPREADSHEET]).encode(encoding))
    raw = read_raw_poses([file])
    (layout,) = possible_layouts(raw)
    assert layout.position.tolist() == [[0.5, -0.25, 1], [0.5, -0.25, 2]] and layout.length_unit == "m"
    assert layout.rotation.tolist() == [[90, 0, 0], [0, 45, 0]] and layout.angle_unit == "deg"
    assert [texts[0] for texts in raw.labels] == ["Süd", "Nord"]
    assert covariate_columns(layout, [0, 1], raw.time_s)["time_s"] == ["0", "60.5"]


def test_bytes_that_are_no_text_are_refused(tmp_path):
    (tmp_path / "Posen.csv").write_bytes(b"1,2,3\0\x81\x8d4,5,6")
    with pytest.raises(InputError, match="is no text"):
        read_raw_poses([tmp_path / "Posen.csv"])


def test_angles_are_no_position_though_their_columns_come_first(tmp_path):
    header = "Giro X [grad],Giro Y [grad],Giro Z [grad],X [mm],Y [mm],Z [mm]"
    (tmp_path / "t.csv").write_text(f"{header}\n1,2,3,400,500,600\n1,2,4,400,500,601\n", encoding="utf-8")
    (layout,) = possible_layouts(read_raw_poses([tmp_path / "t.csv"]))
    assert layout.position[0].tolist() == [400, 500, 600] and layout.rotation[0].tolist() == [1, 2, 3]
    # Gradians or, in German, degrees: left to the scans.
    assert layout.angle_unit is None


@pytest.mark.parametrize(
    ("cells", "seconds"),
    [
        (["09:14", "09:15"], [0, 60]),
        (["2026-02-28T23:59:59.5Z", "2026-03-01 00:00:01"], [0, 1.5]),
        (["31.12.2026 23:00:00", "01.01.2027 01:00:00"], [0, 7200]),
        (["23:59:00", "00:01:00"], None),  # past midnight, or another order?
        (["3/4/2026 09:00:00", "3/5/2026 09:00:00"], None),  # of March, or the third of April?
        (["30.02.2026 09:00:00", "30.02.2026 09:01:00"], None),
        (["9:14", "late"], None),
        (["9:45", "9:75"], None),
        (["23:00", "24:00"], None),
        ([], None),
    ],
)
def test_times_of_day(cells, seconds):
    found = clock_times(cells)
    assert (None if found is None or found.seconds is None else found.seconds.tolist()) == seconds


@pytest.mark.parametrize(
    ("dates", "days", "words"),
    [
        (("03/04/2026", "03/04/2026"), 0, ""),  # one day, whichever
        (("12/04/2026", "13/04/2026"), 1, DAY_FIRST),
        (("4/12/26", "4/13/26"), 1, MONTH_FIRST),
        (("30-04-2026", "01-05-2026"), 1, DAY_FIRST),
        (("03/04/2026", "02/05/2026"), 29, DAY_FIRST),  # the other way it runs backwards
        (("03/04/2026", "04/04/2026"), None, "03/04/2026 8:00 AM may begin with the day or the month"),
        (("2026-04-03", "2026-04-02"), None, "run backwards"),
    ],
)
def test_dates_whose_order_nobody_states(dates, days, words):
    found = clock_times([f"{dates[0]} 8:00 AM", f"{dates[1]} 1:00 PM"])
    assert words in found.words and bool(words) == bool(found.words)
    assert (None if found.seconds is None else found.seconds[1]) == (None if days is None else 86400 * days + 5 * 3600)


def test_what_became_of_the_times_is_said(tmp_path):
    header = "date,x,y,z,qx,qy,qz,qw"
    rows = [f"{month}/4/2026 9:00 AM,{month},0,500,0,0,0,1" for month in (3, 4, 5)]
    (tmp_path / "t.csv").write_text("\n".join([header, *rows]), encoding="utf-8")
    raw = read_raw_poses([tmp_path / "t.csv"])
    assert raw.time_s is None and "to fix: write dates as 2026-12-31" in raw.clock.words


def test_a_column_that_numbers_the_clouds_pairs_them_and_is_no_covariate(tmp_path):
    clouds = [tmp_path / name for name in ("links-3.ply", "mitte-1.ply", "nord-2.ply")]
    (pairing,) = pairings(clouds, [("9:00",), ("9:01",), ("9:02",)], np.array([[1, 0.5], [2, 0.6], [3, 0.7]]))
    assert pairing.rows == (2, 0, 1) and pairing.by_name
    rows = "".join(f"{i};1;2;{i};0;0;{i};{20 + i}\n" for i in (2, 1, 3))
    (tmp_path / "t.csv").write_text(f"Nr;x;y;z;rx;ry;rz;air\n{rows}", encoding="utf-8")
    (layout,) = possible_layouts(read_raw_poses([tmp_path / "t.csv"]))
    assert covariate_columns(layout, [0, 1, 2]) == {"air": ["22", "21", "23"]}


def test_time_and_temperature_beside_a_pose_in_yaml_are_kept(tmp_path):
    files = []
    for i in (1, 2):
        pose = f"tool:\n  position: [1.0, 2.0, {i}.0]\n  quaternion: [0.0, 0.0, 0.0, 1.0]\n"
        files.append(tmp_path / f"p{i}.yaml")
        files[-1].write_text(f"stamp: 2026-03-01T09:0{i}:00\nair: 2{i}.5\n{pose}", encoding="utf-8")
    raw = read_raw_poses(files)
    (layout,) = possible_layouts(raw)
    assert layout.position[1].tolist() == [1, 2, 2]
    assert covariate_columns(layout, [0, 1], raw.time_s) == {"time_s": ["0", "60"], "air": ["21.5", "22.5"]}


def test_files_of_poses_that_are_too_many_are_counted(tmp_path):
    for i in range(9):
        (tmp_path / f"pose{i}.yaml").write_text("a: 1\n", encoding="utf-8")
        (tmp_path / f"scan{i % 3}.ply").write_bytes(b"ply\n")
    with pytest.raises(
        InputError, match=r"no list of poses there \(pose0.yaml … pose8.yaml \(9 files\): holds no poses"
    ):
        find_folder_files(tmp_path)


def test_inverted_poses_of_scans_named_by_no_order(still_cells, tmp_path):
    """Metres, decimal commas, T_flange_base, turns about z, y', x''; the session's views are in the table's order."""
    write_session(tmp_path / "cell", still_cells["eye_in_hand"], "cell")
    folder = raw_folder(tmp_path / "cell", tmp_path / "raw", Convention())
    clouds = sorted((folder).rglob("*.ply"))
    true = session_poses(tmp_path / "cell")[0]
    lines = ["Aufnahme;Lage X [m];Lage Y [m];Lage Z [m];Drehung um Z [°];Drehung um Y [°];Drehung um X [°];Zeit"]
    for i, (name, T, cloud) in enumerate(zip("dbca", true, clouds, strict=True)):
        cloud.rename(cloud.with_name(f"Aufnahme {name}.ply"))
        back = np.linalg.inv(T)
        turns = Rotation.from_matrix(back[:3, :3]).as_euler("ZYX", degrees=True)
        cells = [f"{x:.9f}".replace(".", ",") for x in (*back[:3, 3] / 1000, *turns)]
        lines.append(";".join([f"Aufnahme {name}", *cells, f"09:0{i}"]))
    for table in folder.glob("*.dat"):
        table.unlink()
    (folder / "Posen.csv").write_bytes("\r\n".join(lines).encode("cp1252"))
    first = first_session(folder, StatedFolder())
    write_draft(folder, first)
    read = load_session(folder)
    assert first.choice.determined and [v.name[-1] for v in read.views] == list("dbca")
    assert [v.time_s for v in read.views] == [0, 60, 120, 180]
    T = np.array([v.T_base_flange for v in read.views])
    assert np.abs(T[:, :3, :3] - true[:, :3, :3]).max() < 1e-6
    assert np.abs(1000 * T[:, :3, 3] - true[:, :3, 3]).max() < 1e-3


@pytest.mark.parametrize(
    ("name", "times"),
    [
        ("time", [5.0, 6.5]),
        ("timestamp", [1773216000.0, 1773216001.5]),
        ("timestamp", [1773216000e3, 1773216001.5e3]),
        ("stamp", [1773216000e9, 1773216001.5e9]),
        ("Time [ms]", [5000.0, 6500.0]),
        ("t_min", [0.0, 0.025]),
    ],
)
def test_seconds_of_counts_in_whatever_a_controller_counts(tmp_path, name, times):
    rows = "".join(f"{t!r},{i},0,500,0,0,0,1\n" for i, t in enumerate(times))
    (tmp_path / "t.csv").write_text(f"{name},x,y,z,qx,qy,qz,qw\n{rows}", encoding="utf-8")
    (layout,) = possible_layouts(read_raw_poses([tmp_path / "t.csv"]))
    assert [float(t) for t in covariate_columns(layout, [0, 1])["time_s"]] == pytest.approx([0, 1.5], abs=1e-5)


def test_signs_exponents_and_units_of_other_programs_are_read(tmp_path):
    (tmp_path / "t.txt").write_text("\u22121.5 2.5D+02 3.5\n1.5 \u22122.5d-1 3.5;\n", encoding="utf-8")
    assert read_number_table(tmp_path / "t.txt").numbers.tolist() == [[-1.5, 250, 3.5], [1.5, -0.25, 3.5]]
    (tmp_path / "t.csv").write_text("1.5 mm;2.5 mm;-3.5 mm\n4.5 mm;5.5 mm;6.5 mm\n")
    assert read_number_table(tmp_path / "t.csv").numbers.tolist() == [[1.5, 2.5, -3.5], [4.5, 5.5, 6.5]]


def test_a_text_that_ends_within_its_last_number_loses_that_row(tmp_path):
    rows = "1.125 2.125 3.125\n" * 4
    (tmp_path / "t.txt").write_text(f"{rows}1.125 2.125 3.1")
    table = read_number_table(tmp_path / "t.txt")
    assert len(table.numbers) == 4 and "the last row is cut short" in table.words
    (tmp_path / "t.txt").write_text(f"{rows}1.125 2.125 3.1\n")
    assert len(read_number_table(tmp_path / "t.txt").numbers) == 5
