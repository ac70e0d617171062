"""Files that were made to harm: huge claims, compression bombs, nested or shared structures, code, foreign paths.

Each is a few kilobytes. `MARKER` is the file that code in a pickle would make; a reader that opens `SECRET` follows a
path out of the user's folder.
"""

import io
import json
import os
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from functools import partial

import h5py
import numpy as np

from data_tools.stress.hostile.valid_files import BVH, CAMERA, SPLIT, glb_bytes

MARKER, SECRET = "code-was-run", "secret.txt"
NESTING = 1_000_000
LAUGHS = 48
HUGE = 10**12


class _Code:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (f"touch {MARKER}",)


def bombs(kind: str) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of the bombs for a kind of `valid_files`."""
    makers = {
        "npz": lambda: _npz_bombs("landmarks_px", "<f4"),
        "masks npz": lambda: _npz_bombs("masks", "|u1"),
        "poses npz": lambda: _npz_bombs("frame_index", "<i4"),
        "model npz": lambda: _npz_bombs("v_template", "<f8"),
        "colmap cameras": _colmap_camera_bombs,
        "colmap images": _colmap_image_bombs,
        "masks hdf5": _hdf5_bombs,
        "camera json": lambda: _json_bombs(CAMERA, "fx"),
        "split json": lambda: _json_bombs(SPLIT, "train"),
        "pose json": lambda: _json_bombs({"LeftArm": [1, 0, 0, 0]}, "LeftArm"),
        "bvh": _bvh_bombs,
        "glb": _glb_bombs,
        "pickle": _pickle_bombs,
        "model pkl": _pickle_bombs,
        "camera pkl": _camera_pickle_bombs,
        "video": _video_bombs,
        "png": _png_bombs,
        "preset": _yaml_bombs,
    }
    yield "empty", b""
    yield "zeros", bytes(4096)
    yield from makers[kind]() if kind in makers else ()


def npy_claiming(shape: tuple[int, ...], dtype: str) -> bytes:
    """Return a .npy header that claims an array of this shape, with 16 bytes of content."""
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}"
    header += " " * (63 - (10 + len(header)) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + bytes(16)


def zip_of(members: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return a zip archive."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


def _npz_bombs(name: str, dtype: str) -> Iterator[tuple[str, bytes]]:
    for shape in ((HUGE,), (10**6, 4096, 4096), (2**62, 4), (10**18, 10**18), (-1, 5)):
        yield f"claims {shape}", zip_of({f"{name}.npy": npy_claiming(shape, dtype)})
    yield "objects", zip_of({f"{name}.npy": npy_claiming((1,), "|O") + pickle.dumps(_Code())})
    deep = "(" * 3000 + ")" * 3000
    header = f"{{'descr': '{deep}', 'fortran_order': False, 'shape': (1,), }}\n".encode()
    yield "deep header", zip_of({f"{name}.npy": b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header})
    yield "path out of the archive", zip_of({f"../../{SECRET}.npy": npy_claiming((4,), "<f4"), f"/etc/{name}.npy": b""})
    yield "compression bomb", zip_of({f"{name}.npy": _zeros_npy(6 << 30)})
    yield "no member", zip_of({})
    yield "bare npy", npy_claiming((HUGE,), dtype)
    yield "unknown compression", _with_compression_method(zip_of({f"{name}.npy": npy_claiming((4,), "<f4")}), 97)
    yield "encrypted", _with_encryption_flag(zip_of({f"{name}.npy": npy_claiming((4,), "<f4")}))


def _zeros_npy(count: int) -> bytes:
    """Return a .npy whose header claims `count` bytes, with 4 MiB of zeros, which take 4 kB in an archive."""
    return npy_claiming((count,), "|u1")[:-16] + bytes(4 << 20)


def _with_compression_method(archive: bytes, method: int) -> bytes:
    changed = bytearray(archive)
    for signature, offset in ((b"PK\x03\x04", 8), (b"PK\x01\x02", 10)):
        position = changed.find(signature)
        struct.pack_into("<H", changed, position + offset, method)
    return bytes(changed)


def _with_encryption_flag(archive: bytes) -> bytes:
    changed = bytearray(archive)
    for signature, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        position = changed.find(signature)
        changed[position + offset] |= 1
    return bytes(changed)


def _hdf5_bombs() -> Iterator[tuple[str, bytes]]:
    for shape in ((10**6, 4096, 4096), (HUGE,), (20, 10**5, 10**5)):
        yield f"claims {shape}", _hdf5(partial(_claim_dataset, shape))
    yield "a group", _hdf5(lambda file: file.create_group("masks"))
    yield "strings", _hdf5(lambda file: file.create_dataset("masks", data=[b"a", b"bc"]))
    yield "link to another file", _hdf5(lambda file: file.__setitem__("masks", h5py.ExternalLink(SECRET, "masks")))
    external = [(SECRET, 0, 20 * 64 * 64)]
    yield (
        "bytes of another file",
        _hdf5(lambda file: file.create_dataset("masks", (20, 64, 64), "u1", external=external)),
    )
    yield "link to itself", _hdf5(lambda file: file.__setitem__("masks", h5py.SoftLink("/masks")))


def _claim_dataset(shape: tuple[int, ...], file: h5py.File) -> None:
    file.create_dataset("masks", shape, "u1", chunks=True)


def _hdf5(fill: Callable[[h5py.File], object]) -> bytes:
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        fill(file)
    return content.getvalue()


def _colmap_camera_bombs() -> Iterator[tuple[str, bytes]]:
    for count in (HUGE, 2**64 - 1):
        yield f"{count} cameras", struct.pack("<QiiQQ4d", count, 1, 1, 64, 64, 80.0, 80.0, 32.0, 32.0)
    yield "unknown model", struct.pack("<QiiQQ", 1, 1, 99, 64, 64)
    yield "nan", struct.pack("<QiiQQ4d", 1, 1, 1, 64, 64, float("nan"), 80.0, 32.0, 32.0)


def _colmap_image_bombs() -> Iterator[tuple[str, bytes]]:
    for points in (HUGE, 2**64 - 1):
        image = struct.pack("<i7di", 1, 1.0, *[0.0] * 6, 1) + b"000.png\0" + struct.pack("<Q", points)
        yield f"{points} points", struct.pack("<Q", 2) + image
    yield "name without end", struct.pack("<Qi7di", 1, 1, 1.0, *[0.0] * 6, 1) + b"a" * 100
    yield "no rotation", struct.pack("<Qi7di", 1, 1, *[0.0] * 7, 1) + b"000.png\0" + struct.pack("<Q", 0)


def _json_bombs(valid: object, key: str) -> Iterator[tuple[str, bytes]]:
    yield "nested lists", b"[" * NESTING
    yield "nested objects", b'{"a":' * NESTING
    yield "nested value", json.dumps(valid).replace(f'"{key}": ', f'"{key}": ' + "[" * NESTING, 1).encode()
    document = dict(valid) if isinstance(valid, dict) else {}
    for value in ("NaN", "Infinity", "-1e400", "9" * 5000, '"x"', "null", "[]", "{}", "true", "1e-320"):
        text = json.dumps(document | {key: "@"}).replace('"@"', value)
        yield f"{key} {value[:12]}", text.encode()
    for depth in (40, 900):
        text = json.dumps(document | {key: "@"}).replace('"@"', "[" * depth + "]" * depth)
        yield f"list of depth {depth}", text.encode()
    yield "a list", b"[1, 2]"
    yield "a number", b"3"
    yield "many keys", ("{" + ",".join(f'"k{n}":{n}' for n in range(100_000)) + "}").encode()
    yield "not text", b"\xff\xfe\x00{"
    yield "frame 10^30", json.dumps({"train": [10**30], "heldout": [1]}).encode()
    yield "negative frames", json.dumps({"train": list(range(-20, 0)), "heldout": [1]}).encode()


def _bvh_bombs() -> Iterator[tuple[str, bytes]]:
    changes = {
        "10^6 frames": ("Frames: 2", "Frames: 1000000"),
        "10^30 frames": ("Frames: 2", f"Frames: {10**30}"),
        "negative frames": ("Frames: 2", "Frames: -5"),
        "10^9 channels": ("CHANNELS 6", "CHANNELS 1000000000"),
        "negative channels": ("CHANNELS 6", "CHANNELS -6"),
        "no such axis": ("Xposition", "Qposition"),
        "stray brace": ("HIERARCHY", "HIERARCHY }"),
        "brace without joint": ("ROOT Hips", "{"),
        "channels without joint": ("ROOT Hips\n{", "CHANNELS 1 Xrotation\nROOT Hips\n{"),
        "nan": ("10 20 30", "nan nan nan"),
        "infinity": ("5 6 7", "inf -inf 1e999"),
        "frame time 0": ("0.04", "0"),
        "frame time nan": ("0.04", "nan"),
        "frame time tiny": ("0.04", "1e-320"),
        "two roots": ("MOTION", "ROOT Other\n{\n OFFSET 0 0 0\n CHANNELS 0\n}\nMOTION"),
        "long name": ("LeftArm", "A" * 100_000),
        "empty channel name": ("Xposition", "\u200b"),
    }
    for name, (old, new) in changes.items():
        yield name, BVH.replace(old, new, 1).encode()
    nested = "".join(f"JOINT J{n}\n{{\nOFFSET 0 1 0\nCHANNELS 0\n" for n in range(20_000)) + "}\n" * 20_000
    yield "20,000 nested joints", BVH.replace("End Site", nested + "End Site", 1).encode()


def _glb_bombs() -> Iterator[tuple[str, bytes]]:
    skin = {"joints": [0], "inverseBindMatrices": 0}
    primitive = {"attributes": {"POSITION": 0, "JOINTS_0": 0, "WEIGHTS_0": 0}}
    base: dict[str, object] = {
        "asset": {"version": "2.0"},
        "nodes": [{"name": "Hips"}, {"mesh": 0, "skin": 0}],
        "skins": [skin],
        "meshes": [{"primitives": [primitive]}],
        "bufferViews": [{"buffer": 0, "byteLength": 16}],
    }

    def accessor(**changes: object) -> dict[str, object]:
        return {"bufferView": 0, "componentType": 5126, "count": 1, "type": "VEC4", **changes}

    sparse = {"count": 1, "indices": {"bufferView": 0, "componentType": 5125}, "values": {"bufferView": 0}}
    for count in (HUGE, 2**62, -1, 1.5, "x", True):
        yield f"count {count}", glb_bytes({**base, "accessors": [accessor(count=count)]}, bytes(16))
        wild = {"count": count, "type": "VEC4", "componentType": 5126, "sparse": sparse}
        yield f"sparse count {count}", glb_bytes({**base, "accessors": [wild]}, bytes(16))
    for changes in ({"bufferView": 99}, {"bufferView": -1}, {"type": "MAT9"}, {"componentType": 1}, {"byteOffset": -8}):
        yield f"accessor {changes}", glb_bytes({**base, "accessors": [accessor(**changes)]}, bytes(16))
    for stride in (0, -16, 2**40):
        views = [{"buffer": 0, "byteLength": 16, "byteStride": stride}]
        document = {**base, "bufferViews": views, "accessors": [accessor(count=2)]}
        yield f"stride {stride}", glb_bytes(document, bytes(16))
    for uri in (SECRET, f"../{SECRET}", f"file:///{SECRET}", "http://localhost/x.png", "data:image/png;base64,AAAA"):
        images = {"images": [{"uri": uri}], "textures": [{"source": 0}]}
        materials = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
        document = {**base, **images, "materials": materials, "accessors": [accessor()]}
        yield f"image {uri}", glb_bytes(document, bytes(16))
    cyclic = [{"name": "Hips", "children": [1]}, {"mesh": 0, "skin": 0, "children": [0]}]
    loop = [{"name": "Hips", "children": [1]}, {"mesh": 0, "skin": 0, "children": [1]}]
    yield "a node that is its own child", glb_bytes({**base, "nodes": loop, "accessors": [accessor()]}, bytes(16))
    yield "cyclic nodes", glb_bytes({**base, "nodes": cyclic, "accessors": [accessor()]}, bytes(16))
    for field, value in (("nodes", 5), ("nodes", [7]), ("meshes", []), ("skins", {}), ("accessors", "x")):
        yield f"{field} {value}", glb_bytes({**base, "accessors": [accessor()], field: value}, bytes(16))
    yield "nested JSON", glb_bytes(b"[" * NESTING, b"")
    yield "JSON list", glb_bytes([1, 2], b"")
    yield "chunk of 4 GiB", b"glTF" + struct.pack("<III", 2, 64, 0xFFFFFFFF) + b"JSON{}" + bytes(40)


def _pickle_bombs() -> Iterator[tuple[str, bytes]]:
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        yield f"code, protocol {protocol}", pickle.dumps(_Code(), protocol)
    yield "bytearray of 10^12", b"\x80\x02cbuiltins\nbytearray\nI1000000000000\n\x85R."
    yield "bytearray of 40 GB", b"\x80\x02cbuiltins\nbytearray\nI40000000000\n\x85R."
    yield "bytes of 2^60", b"\x80\x04\x8e" + struct.pack("<Q", 1 << 60) + b"x."
    yield "text of 2^31", b"\x80\x02X" + struct.pack("<I", (1 << 31) - 1) + b"x."
    yield "frame of 2^60", b"\x80\x04\x95" + struct.pack("<Q", 1 << 60) + b"N."
    yield "number of 2^31 bytes", b"\x80\x02\x8b" + struct.pack("<i", (1 << 31) - 1) + b"\x01."
    yield "nested", b"\x80\x02" + b"]" * NESTING + b"a" * (NESTING - 1) + b"."
    yield "shared lists", shared_lists()
    yield "array of 10^12", _array_pickle((HUGE,), "f8", b"")
    yield "dtype of 10^12 bytes", _array_pickle((1,), f"V{HUGE}", b"")
    yield "memo 2^31", b"\x80\x02Nr" + struct.pack("<I", (1 << 31) - 1) + b"."


def shared_lists() -> bytes:
    """Return a pickle of nested pairs that share their parts: 2 to the power of `LAUGHS` numbers in a few bytes."""
    value: list[object] = [1.0, 2.0]
    for _ in range(LAUGHS):
        value = [value, value]
    return pickle.dumps(value, 2)


def _array_pickle(shape: tuple[int, ...], dtype: str, content: bytes) -> bytes:
    head = b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R(K\x01"
    dims = b"(" + b"".join(b"I%d\n" % side for side in shape) + b"t"
    kind = b"cnumpy\ndtype\nX" + struct.pack("<I", len(dtype)) + dtype.encode() + b"K\x00K\x01\x87R"
    return head + dims + kind + b"\x89B" + struct.pack("<I", len(content)) + content + b"tb."


def _camera_pickle_bombs() -> Iterator[tuple[str, bytes]]:
    yield from _pickle_bombs()
    laughs = pickle.loads(shared_lists())  # noqa: S301 - made three lines above
    yield "shared lists as a number", pickle.dumps({"camera_f": laughs}, 2)
    for value in (np.nan, np.inf, 1e300, 0.0, -5.0):
        numbers = {"camera_f": 2, "camera_c": 2, "camera_k": 5, "camera_rt": 3, "camera_t": 3}
        camera = {name: np.full(size, value) for name, size in numbers.items()}
        yield f"camera of {value}", pickle.dumps(camera | {"width": 64, "height": 64}, 2)
        yield f"width {value}", pickle.dumps(camera | {"width": value, "height": value}, 2)


def _video_bombs() -> Iterator[tuple[str, bytes]]:
    playlist = f"#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{SECRET}\n#EXT-X-ENDLIST\n"
    yield "playlist", playlist.encode()
    yield "playlist of a file", playlist.replace(SECRET, f"file:///etc/passwd\n{SECRET}").encode()
    yield "playlist of an address", playlist.replace(SECRET, "http://127.0.0.1:9/x.ts").encode()
    yield "concatenation", f"ffconcat version 1.0\nfile {SECRET}\n".encode()
    yield "concatenation out of the folder", f"ffconcat version 1.0\nfile ../{SECRET}\n".encode()
    yield (
        "session description",
        b"v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 9 RTP/AVP 96\n",
    )
    gif = bytearray(b"GIF89a" + struct.pack("<HHBBB", 65535, 65535, 0x80, 0, 0) + bytes(6))
    gif += b"," + struct.pack("<HHHHB", 0, 0, 65535, 65535, 0) + b"\x02\x02\x44\x01\x00;"
    yield "gif of 65535 x 65535", bytes(gif)
    avi = b"RIFF\xff\xff\xff\x7fAVI LIST\xff\xff\xff\x7fhdrlavih\x38\x00\x00\x00"
    yield "avi of 10^9 frames", avi + struct.pack("<14I", 1, 1, 0, 16, 10**9, 0, 1, 0, 65535, 65535, 0, 0, 0, 0)


def _png_bombs() -> Iterator[tuple[str, bytes]]:
    def chunk(kind: bytes, content: bytes) -> bytes:
        body = kind + content
        return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))

    for side in (60_000, 2**31 - 1):
        header = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0))
        data = chunk(b"IDAT", zlib.compress(bytes(1 << 20)))
        yield f"{side} x {side}", b"\x89PNG\r\n\x1a\n" + header + data + chunk(b"IEND", b"")
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 8, 8, 8, 2, 0, 0, 0))
    text = chunk(b"zTXt", b"Comment\0\0" + zlib.compress(bytes(64 << 20), 9))
    profile = chunk(b"iCCP", b"icc\0\0" + zlib.compress(bytes(64 << 20), 9))
    pixels = chunk(b"IDAT", zlib.compress(bytes(8 * 25))) + chunk(b"IEND", b"")
    yield "text bomb", b"\x89PNG\r\n\x1a\n" + header + text + pixels
    yield "profile bomb", b"\x89PNG\r\n\x1a\n" + header + profile + pixels


def _yaml_bombs() -> Iterator[tuple[str, bytes]]:
    lines = ["a0: &a0 [1, 2]"] + [f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]" for n in range(1, LAUGHS)]
    shared = "\n".join(f"  {line}" for line in lines)
    yield "shared lists", f"mesh:\n{shared}\n  rounds: *a{LAUGHS - 1}\n".encode()
    yield "shared lists as a section", ("\n".join(lines) + f"\nmesh: *a{LAUGHS - 1}\n").encode()
    yield "nested", ("mesh: " + "[" * 20_000).encode()
    yield "code", f"mesh: !!python/object/apply:os.system ['touch {MARKER}']\n".encode()
    yield "itself", b"mesh: &m\n  rounds: *m\n"
    for value in (".nan", ".inf", "1e400", "9" * 5000, "null", "[]", "{}", "2001-01-01", "0x7fffffffffffffff"):
        yield f"rounds {value[:12]}", f"mesh:\n  rounds: {value}\n".encode()
