"""What a diagnosis says on the shop floor, and the command that it names."""

from types import SimpleNamespace

import pytest

from bench.page_blocks import refused
from stitch.effects import EFFECTS
from stitch.writing.plain_effects import in_words
from stitch.writing.plain_finding import next_step


def test_every_effect_of_the_library_has_words():
    library = [effect.name for effect in EFFECTS.values() if effect.tier == "physical"]
    said = [in_words(name) for name in library]
    assert len(said) > 20 and len(set(said)) == len(said)
    assert all(words.startswith(f"{name} (") for name, words in zip(library, said, strict=True))
    assert in_words("of_my_own") == "of_my_own"


@pytest.mark.parametrize("verdict", ["missing_effect", "cannot_tell", "unknown_effect", "adequate"])
@pytest.mark.parametrize("curves", [(), ("of joint 3",)])
def test_the_next_command_can_be_typed(verdict, curves):
    told = next_step(SimpleNamespace(verdict=verdict, curves=curves), "RUN")
    command = told.rsplit(": ", 1)[1]
    assert command.startswith("stitch ") and refused(command) is None
