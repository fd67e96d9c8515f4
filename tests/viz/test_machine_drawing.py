"""The machine as a drawing: what errs is marked, and nothing where no arm is known."""

import re
from dataclasses import replace

import numpy as np
import pytest

import stitch
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import clean, plan_for
from data_synth.simulate import simulate
from viz.machine_drawing import machine_svg


@pytest.fixture(scope="module")
def run():
    scene = clean("blade", rays=40)
    planned = plan_for(scene, 2, 6)
    return stitch.run(session_of(simulate(scene, {}, 2, planned=planned)))


def circles(svg):
    return re.findall(r'<circle [^>]*fill="([^"]*)"', svg)


def test_every_joint_is_drawn_and_the_one_that_errs_is_marked_and_moves(run):
    svg = machine_svg(run, "joint 5")
    fills = circles(svg)
    assert len(fills) == run.session.robot.n_joints
    assert fills.count("var(--best)") == 1 and ">5</text>" in svg
    assert "stroke-dasharray" in svg.split("<polyline", 2)[2].split("/>")[0]


def test_without_a_cause_nothing_is_marked(run):
    assert "var(--best)" not in machine_svg(run)


@pytest.mark.parametrize(
    "errs, name", [("the scanner's mount", "mount"), ("the scanner", "scanner"), ("the part", "part")]
)
def test_mount_scanner_and_part_are_marked_where_they_err(run, errs, name):
    svg = machine_svg(run, errs)
    marked = re.search(r'fill="var\(--best\)"/><text[^>]*>(\w+)</text>', svg)
    assert marked[1] == name


def test_everything_lies_within_the_picture(run):
    points = re.findall(r'points="([^"]*)"', machine_svg(run, "joint 2"))
    places = np.array([pair.split(",") for line in points for pair in line.split()], float)
    assert (places > 0).all() and (places < [230, 250]).all()


def test_without_an_arm_there_is_no_drawing(run):
    assert machine_svg(replace(run, session=replace(run.session, robot=None))) == ""
