"""The commands of docs/own-data.md, on the folder that the page speaks of."""

import re

import pytest

from bench.own_data_output import PAGE, prepare
from bench.readme_output import commands, printed, shown

# A simulation, a run and a diagnosis.
pytestmark = pytest.mark.slow
NUMBER = re.compile(r"\d[\d,.]*")


def test_a_raw_folder_leads_to_the_verdict_that_the_page_shows(tmp_path):
    page = shown(PAGE)
    prepare(tmp_path)
    anew = printed(commands(page), tmp_path)
    first, last = (text.split("$ stitch ")[1:] for text in (anew, page))
    # What init says, to the letter but for the figures; of the rest what it comes to.
    assert NUMBER.sub("#", " ".join(first[0].split())) == NUMBER.sub("#", " ".join(last[0].split()))
    assert "range_scale is missing" in first[2] and "range_scale is missing" in last[2]
