"""Files made to break a reader: disguises, bombs, lies and damage, each with the code it must end in."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from tests.engine.video.clips import make_audio, make_clip, moving, quadrants
from tests.engine.video.surgery import append_to, box, find, full_box, patch, replace_box

#: The outcome of a file whose lie does no harm.
FRAMES = "frames"
TRAK = (b"moov", b"trak")
STBL = (*TRAK, b"mdia", b"minf", b"stbl")
UNSUPPORTED, CORRUPT = "video.unsupported_container", "video.corrupt"
TOO_LONG, NO_VIDEO = "video.too_long", "video.no_video_track"


def clip(path: Path, **options: str) -> bytes:
    """A good mp4 of 12 frames, 64x48, its media before its index."""
    return make_clip(path.with_name("good.mp4"), moving(12), None, **options).read_bytes()


def secret(path: Path) -> None:
    """A good clip beside ``path`` that no other file may lead to."""
    make_clip(path.with_name("secret.mp4"), [quadrants()] * 3)


# Not a video at all, whatever the name says.


def text(content: str) -> Callable[[Path], None]:
    """A text file, with a clip beside it that it may name."""

    def make(path: Path) -> None:
        secret(path)
        path.write_text(content.format(folder=path.parent))

    return make


def raw(content: bytes) -> Callable[[Path], None]:
    """A file of these bytes."""

    def make(path: Path) -> None:
        path.write_bytes(content)

    return make


def zipped(path: Path) -> None:
    make_clip(path.with_name("inner.mp4"), [quadrants()] * 3)
    with zipfile.ZipFile(path, "w") as archive:
        archive.write(path.with_name("inner.mp4"), "clip.mp4")


def picture(extension: str) -> Callable[[Path], None]:
    """A still picture."""
    return raw(cv2.imencode(extension, quadrants())[1].tobytes())


def sound(path: Path) -> None:
    make_audio(path)


# Structures that lie or lead astray.


def claimed(count: int, *place: bytes) -> Callable[[Path], None]:
    """A sample table of ``count`` samples in 20 bytes, where it belongs or at ``place``."""

    def make(path: Path) -> None:
        table = full_box(b"stsz", struct.pack(">II", 1, count))
        data = clip(path)
        if place:
            path.write_bytes(append_to(data, table, *place))
            return
        data = replace_box(data, table, *STBL, b"stsz")
        data = replace_box(data, full_box(b"stsc", struct.pack(">IIII", 1, 1, count, 1)), *STBL, b"stsc")
        path.write_bytes(
            replace_box(data, full_box(b"stts", struct.pack(">III", 1, count, 1)), *STBL, b"stts")
        )

    return make


def real_entries(path: Path) -> None:
    """Two million sample sizes, 8 MB, all there."""
    count = 2_000_000
    claimed(count)(path)
    table = full_box(b"stsz", struct.pack(">II", 0, count), b"\0\0\0\1" * count)
    path.write_bytes(replace_box(path.read_bytes(), table, *STBL, b"stsz"))


def claimed_fragment(path: Path) -> None:
    """One fragment that claims four thousand million samples without a byte for any."""
    data = clip(path, movflags="frag_keyframe+empty_moov+default_base_moof")
    run = full_box(b"trun", struct.pack(">Ii", 0xF000_0000, 100), flags=1)
    path.write_bytes(replace_box(data, run, b"moof", b"traf", b"trun"))


def edits(count: int) -> Callable[[Path], None]:
    """An edit list that shows the whole clip ``count`` times."""

    def make(path: Path) -> None:
        entries = struct.pack(">IiHH", 480, 0, 1, 0) * count
        table = full_box(b"elst", struct.pack(">I", count), entries)
        path.write_bytes(replace_box(clip(path), table, *TRAK, b"edts", b"elst"))

    return make


def edited_bomb(path: Path) -> None:
    """Few enough edits, few enough samples, but 200 times 17 thousand."""
    claimed(17_000)(path)
    table = full_box(b"elst", struct.pack(">I", 200), struct.pack(">IiHH", 480, 0, 1, 0) * 200)
    path.write_bytes(replace_box(path.read_bytes(), table, *TRAK, b"edts", b"elst"))


def compressed_index(path: Path) -> None:
    data = clip(path)
    at, size = find(data, b"moov")
    packed = zlib.compress(data[at : at + size])
    squeezed = box(b"cmov", box(b"dcom", b"zlib"), box(b"cmvd", struct.pack(">I", size), packed))
    path.write_bytes(data[:at] + box(b"moov", squeezed))


def nested(path: Path) -> None:
    """Boxes in boxes, twenty thousand deep."""
    depth = 20_000
    tower = b"".join(struct.pack(">I", 8 * (depth - i)) + b"trak" for i in range(depth))
    path.write_bytes(box(b"ftyp", b"isom", bytes(8)) + box(b"moov", tower))


def many_tracks(path: Path) -> None:
    """A hundred thousand empty tracks."""
    path.write_bytes(box(b"ftyp", b"isom", bytes(8)) + box(b"moov", box(b"trak") * 100_000))


def zero_sizes(path: Path) -> None:
    """Boxes of size 0, "to the end of the file", inside one another."""
    path.write_bytes(box(b"ftyp", b"isom", bytes(8)) + (bytes(4) + b"moov" + bytes(4) + b"trak") * 50)


def box_size(size: int) -> Callable[[Path], None]:
    """A good clip whose index box has this size written on it."""

    def make(path: Path) -> None:
        data = clip(path)
        at, _ = find(data, b"moov")
        path.write_bytes(patch(data, at, struct.pack(">I", size)))

    return make


def negative_box(path: Path) -> None:
    path.write_bytes(
        box(b"ftyp", b"isom", bytes(8)) + struct.pack(">I4sQ", 1, b"moov", 2**63 + 5) + bytes(100)
    )


def outside(path: Path) -> None:
    """The media lies where the file has long ended."""
    data = clip(path)
    chunks = full_box(b"co64", struct.pack(">IQ", 1, 1 << 40))
    path.write_bytes(replace_box(data, chunks, *STBL, b"stco"))


def elsewhere(path: Path) -> None:
    """The media lies in another file, and there is none in this one."""
    secret(path)
    data = clip(path)
    reference = full_box(b"dref", struct.pack(">I", 1), full_box(b"url ", b"secret.mp4\0"))
    data = replace_box(data, reference, *TRAK, b"mdia", b"minf", b"dinf", b"dref")
    at, size = find(data, b"mdat")
    path.write_bytes(patch(data, at + 8, bytes(size - 8)))


def claimed_size(path: Path) -> None:
    """65,535 by 65,535 pixels in the track, the sample entry and nowhere else."""
    data = clip(path, movflags="+faststart")
    at, _ = find(data, *STBL, b"stsd")
    path.write_bytes(patch(data, at + 16 + 8 + 24, b"\xff\xff\xff\xff"))


def pixel_bomb(path: Path) -> None:
    """A few hundred bytes of VP8 whose key frame says it has 268 million pixels."""
    make_clip(path.with_suffix(".webm"), [quadrants()] * 3, codec="libvpx")
    data = path.with_suffix(".webm").read_bytes()
    at = data.index(b"\x9d\x01\x2a") + 3  # RFC 6386: start code, then 14 bits of width, 14 of height
    path.write_bytes(patch(data, at, struct.pack("<HH", 0x3FFF, 0x3FFF)))


def without_clock(path: Path) -> None:
    """A time scale of zero ticks a second."""
    data = clip(path)
    at, _ = find(data, *TRAK, b"mdia", b"mdhd")
    path.write_bytes(patch(data, at + 20, bytes(4)))


def for_ages(path: Path) -> None:
    """Twelve frames that claim to last for days."""
    data = replace_box(clip(path), box(b"free"), *TRAK, b"edts")
    times = full_box(b"stts", struct.pack(">III", 1, 12, 0x7FFF_FFFF // 12))
    path.write_bytes(replace_box(data, times, *STBL, b"stts"))


def one_frame(path: Path) -> None:
    make_clip(path, [quadrants()])


def without_index(path: Path) -> None:
    whole = clip(path)
    path.write_bytes(whole[: len(whole) // 2])


def zeroed_media(path: Path) -> None:
    data = clip(path)
    at, size = find(data, b"mdat")
    path.write_bytes(patch(data, at + 8, bytes(size - 8)))


def noise_after(head: bytes, seed: int = 1) -> Callable[[Path], None]:
    """A magic number, then noise."""
    noise = np.random.default_rng(seed).integers(0, 256, 20_000, dtype=np.uint8).tobytes()
    return raw(head + noise)


FTYP = b"\0\0\0\x18ftypisom" + bytes(12)
EBML = b"\x1a\x45\xdf\xa3"
PLAYLIST = "#EXTM3U\n#EXT-X-TARGETDURATION:3\n#EXTINF:3,\n{folder}/secret.mp4\n#EXT-X-ENDLIST\n"
CONCAT = "ffconcat version 1.0\nfile secret.mp4\n"

BROKEN: dict[str, tuple[Callable[[Path], None], str]] = {
    "empty": (raw(b""), "video.empty"),
    "one byte": (raw(b"\0"), UNSUPPORTED),
    "text": (text("not a video\n" * 100), UNSUPPORTED),
    "web page": (text("<!doctype html><video src=secret.mp4></video>"), UNSUPPORTED),
    "drawing": (
        text("<svg xmlns='http://www.w3.org/2000/svg'><image href='secret.mp4'/></svg>"),
        UNSUPPORTED,
    ),
    "HLS playlist": (text(PLAYLIST), UNSUPPORTED),
    "concat playlist": (text(CONCAT), UNSUPPORTED),
    "DASH manifest": (text("<?xml version='1.0'?><MPD><BaseURL>secret.mp4</BaseURL></MPD>"), UNSUPPORTED),
    "session description": (text("v=0\no=- 0 0 IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n"), UNSUPPORTED),
    "playlist behind a magic number": (text("\0\0\0\x18ftypisom\n" + CONCAT), CORRUPT),
    "playlist behind a whole box": (text(FTYP.decode() + PLAYLIST), CORRUPT),
    "zip": (zipped, UNSUPPORTED),
    "gif": (raw(b"GIF89a" + bytes(100)), UNSUPPORTED),
    "png": (picture(".png"), UNSUPPORTED),
    "jpeg": (picture(".jpg"), UNSUPPORTED),
    "avi": (raw(b"RIFF\x00\x10\x00\x00AVI LIST" + bytes(500)), UNSUPPORTED),
    "sound only": (sound, NO_VIDEO),
    "only a file type": (raw(FTYP), CORRUPT),
    "only an EBML head": (raw(EBML + bytes(200)), CORRUPT),
    "noise after a file type": (noise_after(FTYP), CORRUPT),
    "noise after an EBML head": (noise_after(EBML), CORRUPT),
    "index cut off": (without_index, CORRUPT),
    "media zeroed": (zeroed_media, CORRUPT),
    "media outside the file": (outside, CORRUPT),
    "media in another file": (elsewhere, CORRUPT),
    "index box of 7 bytes": (box_size(7), CORRUPT),
    "index box of 4 GB, cut": (box_size(0xFFFF_FFFF), FRAMES),
    "box of negative size": (negative_box, NO_VIDEO),
    "zero-length boxes": (zero_sizes, CORRUPT),
    "deeply nested boxes": (nested, NO_VIDEO),
    "a hundred thousand tracks": (many_tracks, CORRUPT),
    "two million real index entries": (real_entries, TOO_LONG),
    "a million claimed samples": (claimed(1_000_000), TOO_LONG),
    "four thousand million claimed samples": (claimed(0xFFFF_FFFF), TOO_LONG),
    "claimed samples in an odd place": (claimed(0xF000_0000, *TRAK), TOO_LONG),
    "claimed samples in a fragment": (claimed_fragment, TOO_LONG),
    "flood of edits": (edits(20_000), "video.too_many_edits"),
    "edits times samples": (edited_bomb, TOO_LONG),
    "compressed index": (compressed_index, UNSUPPORTED),
    "claims to last for days": (for_ages, TOO_LONG),
    "time scale of zero": (without_clock, CORRUPT),
    "claims 65535x65535 in the index": (claimed_size, FRAMES),
    "claims 16383x16383 in a frame": (pixel_bomb, CORRUPT),
    "one frame": (one_frame, "video.too_short"),
}
