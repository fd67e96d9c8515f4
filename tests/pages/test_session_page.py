"""The page of files and keys: its session.toml is read, and no key of what is written lacks on it."""

import json
import re

import numpy as np

from bench.docs.page_blocks import ROOT, blocks
from data_synth.fixtures.labelled_arm import DH_ROWS, labelled_cell
from stitch.api.pipeline import diagnose, run
from stitch.output.diagnosis_document import diagnosis_document
from stitch.output.result_document import ledger, result_document
from stitch.session.reading.session_folder import load_session

PAGE = ROOT / "docs" / "session.md"


def test_the_session_of_the_page_is_read(session):
    (text,) = (b.text for b in blocks(PAGE) if b.language == "toml")
    rows = ", ".join("{ " + ", ".join(f"{key} = {x}" for key, x in row.items()) + " }" for row in DH_ROWS)
    text = text.replace("[[…4],[…4],[…4],[0,0,0,1]]", json.dumps(np.eye(4).tolist()))
    text = re.sub(r"joints = \[ (\{.*?\}), … \]", rf"joints = [ \1, {rows} ]", text)
    # A radius says that every cloud shows one sphere, which a blade does not.
    text = re.sub(r"(?m)^radius = .*$", "", text)
    assert "…" not in text
    (session / "session.toml").write_text(text, encoding="utf-8")
    (session / "blade.stl").write_text("solid s\nendsolid s\n")
    found = load_session(session)
    assert found.name == "blade-17" and found.scanner.noise == 0.02 and found.repeatability.position == 0.05


def test_every_key_that_a_run_writes_stands_on_the_page(few_effects):
    cell, *_ = labelled_cell(1, views=12)
    found = run(cell)
    diagnosed = diagnosis_document(diagnose(found))
    candidates = [row | {"candidates": None} for row in diagnosed.pop("candidates")]
    named = set(re.findall(r"`([\w]+)`", PAGE.read_text(encoding="utf-8")))
    documents = (result_document(found), *ledger(found), diagnosed, *candidates)
    missing = sorted({key for document in documents for key in document} - named)
    assert not missing
