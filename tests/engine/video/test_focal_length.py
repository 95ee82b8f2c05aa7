"""The field of view that a camera wrote into the file."""

from __future__ import annotations

from pathlib import Path

import av
import pytest

from mass_engine.options import FitOptions
from mass_engine.survey import survey_camera
from mass_engine.video.focal_length import field_of_view
from mass_engine.video.reader import probe
from tests.engine.video.clips import make_clip, moving

KEY = "com.apple.quicktime.camera.focal_length.35mm_equivalent"


def test_film_itself_and_a_phone() -> None:
    assert field_of_view({KEY: "18"}, 3600, 2400) == pytest.approx(90.0)
    assert field_of_view({KEY: "26"}, 1920, 1080) == pytest.approx(71.90, abs=0.01)
    assert field_of_view({KEY: "26"}, 1080, 1920) == field_of_view({KEY: "26 mm"}, 1920, 1080)
    assert field_of_view({"FocalLengthIn35mmFilm": "26"}, 1920, 1080) is not None


@pytest.mark.parametrize("value", ["", "wide", "0", "-5", "nan", "inf", "1", "900"])
def test_nonsense_is_no_focal_length(value: str) -> None:
    assert field_of_view({KEY: value}, 1920, 1080) is None


def test_it_is_read_from_the_file_and_the_user_is_heard_first(tmp_path: Path) -> None:
    plain, tagged = tmp_path / "plain.mp4", tmp_path / "tagged.mp4"
    make_clip(plain, moving(12), None)
    with (
        av.open(str(plain)) as old,
        av.open(str(tagged), "w", options={"movflags": "use_metadata_tags"}) as new,
    ):
        new.metadata[KEY] = "26"
        stream = new.add_stream_from_template(old.streams.video[0])
        for packet in old.demux(old.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                new.mux(packet)
    info = probe(tagged)
    assert info.fov == field_of_view({KEY: "26"}, info.width, info.height)
    camera, source = survey_camera(info, FitOptions())
    assert source == "metadata"
    assert camera.fov_degrees == pytest.approx(info.fov)
    assert survey_camera(info, FitOptions(fov=40.0))[1] == "given"
    assert probe(plain).fov is None
    assert survey_camera(probe(plain), FitOptions())[1] == "assumed"
