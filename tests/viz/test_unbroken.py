"""Lines end where nobody reads a number without its unit."""

import pytest

from viz.page_parts import render, unbroken


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        ("21.9 µm: by 18.6 µm and 0.044 mrad", "21.9~µm: by 18.6~µm and 0.044~mrad"),
        ("c2 = 0.43 ± 0.04 µrad/(N m), c3", "c2~=~0.43~±~0.04~µrad/(N~m), c3"),
        ("g = −3 ± 1 ppm/°C", "g~=~−3~±~1~ppm/°C"),
        ("95 % of the part, 2.5 MB, 120 °C (1 σ)", "95~% of the part, 2.5~MB, 120~°C (1~σ)"),
        ("12 views, 3 scans, 4 models, 2 hours, 5 mms", "12 views, 3 scans, 4 models, 2 hours, 5 mms"),
        ("3 minutes; [1 0 0]; x = x* + u; p = 2e-22", "3 minutes; [1 0 0]; x = x* + u; p~=~2e-22"),
    ],
)
def test_numbers_stay_with_their_units(text, kept):
    assert unbroken(text).replace("\u00a0", "~") == kept


def test_pages_keep_them_together_and_markup_as_it_is():
    page = render("review.html.j2", nonce="", run="<b>5 mm</b>")
    assert "&lt;b&gt;5\u00a0mm&lt;/b&gt;" in page
    assert "1px solid" in page
