"""Pickles: arrays of all protocols and of Python 2 come back, and nothing a pickle names is ever run."""

import os
import pickle
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest

from pipeline.core.errors import UserError
from pipeline.io import safe_pickle
from pipeline.io.safe_pickle import OpaqueObject, load_npy, load_pickle


class Call:
    """Pickles to a call of any function."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


class Made:
    """Pickles to any call and any state of what it returns (BUILD)."""

    def __init__(self, function, arguments, state):
        self.parts = (function, arguments, state)

    def __reduce__(self):
        return self.parts


class Circular:
    """Pickles to a numpy type that is a field of itself."""

    def __reduce__(self):
        return np.dtype, ("V8", False, True), (3, "|", None, ("a",), {"a": (self, 0)}, 8, 1, 16)


class Foreign:
    """Stands for a class of a package that must not be run."""

    def __init__(self) -> None:
        self.x = np.arange(3.0)

    def __setstate__(self, state) -> None:
        raise AssertionError("a foreign class was built")


FOREIGN = f"{Foreign.__module__}.Foreign"


def written(folder: Path, content: object, protocol: int = 2) -> Path:
    path = folder / "some.pkl"
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    return path


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_and_containers_come_back(tmp_path, protocol):
    content = {
        "floats": np.linspace(0, 1, 6).reshape(2, 3),
        "column order": np.asfortranarray(np.arange(6, dtype=np.uint32).reshape(2, 3)),
        "objects": np.array([None, "x", (1, 2)], dtype=object),
        "fields": np.zeros(2, dtype=[("a", "f4"), ("b", "i2", (3,))]),
        "other byte order": np.arange(3, dtype=">i4"),
        "words": np.array(["one", "four"]),
        "scalar": np.float32(2.5),
        "rest": [1, 2.5, True, None, "text", b"\x00\xff", (1,), {3}, frozenset({4}), 1j, OrderedDict(a=1)],
    }
    read = load_pickle(written(tmp_path, content, protocol))
    for name in ("floats", "column order", "fields", "words"):
        np.testing.assert_array_equal(read[name], content[name])
        assert read[name].dtype == content[name].dtype
    np.testing.assert_array_equal(read["other byte order"], [0, 1, 2])
    assert read["objects"].tolist() == content["objects"].tolist()
    assert read["scalar"] == content["scalar"]
    assert read["rest"] == content["rest"]


def test_python_2_bytes_are_latin1(tmp_path):
    """`pickle.dumps({'c': numpy.array([1.5, -2.0])}, 0)` as Python 2 writes it, by hand."""
    buffer = np.array([1.5, -2.0]).tobytes()
    lines = (
        b"(dp0\nS'c'\np1\ncnumpy.core.multiarray\n_reconstruct\np2\n(cnumpy\nndarray\np3\n(I0\ntp4\nS'b'\np5\ntp6\nRp7\n"
        b"(I1\n(I2\ntp8\ncnumpy\ndtype\np9\n(S'f8'\np10\nI0\nI1\ntp11\nRp12\n"
        b"(I3\nS'<'\np13\nNNNI-1\nI-1\nI0\ntp14\nbI00\nS" + ascii(buffer)[1:].encode() + b"\np15\ntp16\nbs."
    )
    path = tmp_path / "two.pkl"
    path.write_bytes(lines)
    np.testing.assert_array_equal(load_pickle(path)["c"], [1.5, -2.0])


@pytest.mark.parametrize(
    ("function", "arguments", "name"),
    [
        (os.system, ("touch {marker}",), "system"),
        (eval, ("open('{marker}', 'w')",), "eval"),
        (exec, ("open('{marker}', 'w')",), "exec"),
        (getattr, (np, "load"), "getattr"),
        (open, ("{marker}", "w"), "open"),
        (np.fromfile, ("{marker}",), "fromfile"),
        (Path, ("{marker}",), "Path"),
    ],
)
@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_a_call_is_refused_by_name_and_not_made(tmp_path, function, arguments, name, protocol):
    marker = tmp_path / "marker"
    filled = [a.format(marker=marker) if isinstance(a, str) else "numpy" for a in arguments]
    path = written(tmp_path, {"camera_f": Call(function, *filled)}, protocol)
    with pytest.raises(UserError, match=rf"some.pkl is refused: it contains `.*{name}`"):
        load_pickle(path)
    assert not marker.exists()


def test_a_marker_would_have_been_made(tmp_path):
    """The attack is a real one: the plain unpickler runs it."""
    marker = tmp_path / "marker"
    pickle.loads(pickle.dumps(Call(os.system, f"touch {marker}")))
    assert marker.exists()


POINTER = id(None).to_bytes(8, "little")
RECONSTRUCT, SCALAR = np.zeros(1).__reduce__()[0], np.float64(0).__reduce__()[0]
FROM_BUFFER = np.zeros(1).__reduce_ex__(5)[0]


@pytest.mark.parametrize("opcode", [pickle.REDUCE, pickle.NEWOBJ])
def test_no_array_is_made_of_pointers(tmp_path, opcode):
    """`numpy.ndarray((1,), "O", 8 bytes)` takes the bytes for the address of an object, whatever lies there."""
    assert np.ndarray((1,), "O", POINTER).tolist() == [None]  # the attack is a real one
    arguments = pickle.dumps(((1,), "O", POINTER), 3)[2:-1]
    path = tmp_path / "some.pkl"
    path.write_bytes(pickle.PROTO + b"\3" + b"cnumpy\nndarray\n" + arguments + opcode + b".")
    with pytest.raises(UserError, match=r"some\.pkl cannot be read"):
        load_pickle(path)


def made_array(kind: object, shape: tuple[int, ...], content: object) -> Made:
    return Made(RECONSTRUCT, (np.ndarray, (0,), b"b"), (1, shape, kind, False, content))


def made_type(name: str, state: tuple) -> Made:
    return Made(np.dtype, (name, False, True), state)


@pytest.mark.parametrize(
    "content",
    [
        made_array(made_type("O8", (3, "|", None, None, None, -1, -1, 0)), (1,), POINTER),
        made_array(made_type("V8", (3, "|", None, ("a",), {"a": (np.dtype("O"), 0)}, 8, 1, 0)), (1,), POINTER),
        made_array(made_type("V8", (3, "|", None, ("a",), {"a": (np.dtype("f8"), 4096)}, 8, 1, 0)), (1,), POINTER),
        made_array(np.dtype("O"), (3,), [1]),
        made_array(Circular(), (1,), POINTER),
        Call(SCALAR, np.dtype([("a", "O")]), np.frombuffer(POINTER)),
        Call(SCALAR, np.dtype("O"), POINTER),
        Call(FROM_BUFFER, np.zeros(2), np.dtype("f8"), (2,), "C"),
    ],
    ids=[
        *("type of objects that denies it", "field of objects that denies it", "field beyond the end"),
        *("fewer objects than places", "type within itself", "scalar of a foreign pointer"),
        *("scalar object", "view of another array"),
    ],
)
@pytest.mark.parametrize("protocol", [2, 4])
def test_inconsistent_array_descriptions_are_refused(tmp_path, content, protocol):
    """Each of these makes numpy read where nothing of the pickle lies, or could."""
    with pytest.raises(UserError, match=r"some\.pkl (cannot be read|is refused)"):
        load_pickle(written(tmp_path, content, protocol))


def test_a_type_cannot_be_changed_under_an_array(tmp_path):
    """BUILD on a type that an array has already: its bytes would become pointers."""
    late = pickle.dumps((3, "|", None, ("a",), {"a": (np.dtype("O"), 0)}, 8, 1, 63), 3)[2:-1]
    kind = b"cnumpy\ndtype\n(S'V8'\nI00\nI01\ntRp900\n"
    array = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntC\1btR"
    array += b"(I1\n(I1\ntg900\nI00\nC\x08" + POINTER + b"tb"
    path = tmp_path / "late.pkl"
    path.write_bytes(pickle.PROTO + b"\3]" + kind + b"0" + array + b"ag900\n" + late + b"b0.")
    assert [array.dtype for array in load_pickle(path)] == [np.dtype("V8")]


def test_nothing_but_arrays_types_and_records_gets_a_state(tmp_path):
    """It would be set as attributes, here as the defaults of a function that the next pickle calls."""
    path = tmp_path / "some.pkl"
    path.write_bytes(b"c_codecs\nencode\n(N(S'__defaults__'\n(S'latin1'\ntdtb.")
    with pytest.raises(UserError, match="BUILD on an object of type function"):
        load_pickle(path)


def test_dotted_names_lead_nowhere(tmp_path):
    """Protocol 4 can name `numpy` and `ndarray.tofile`, which starts like an allowed name."""
    path = tmp_path / "dotted.pkl"
    path.write_bytes(b"\x80\x04\x8c\x05numpy\x8c\x0endarray.tofile\x93.")
    with pytest.raises(UserError, match="`numpy.ndarray.tofile`"):
        load_pickle(path)


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_foreign_objects_load_as_opaque_only_when_listed(tmp_path, protocol):
    path = written(tmp_path, {"shape": Foreign()}, protocol)
    with pytest.raises(UserError, match="Foreign|_reconstructor"):
        load_pickle(path)
    record = load_pickle(path, opaque_classes=[FOREIGN])["shape"]
    assert isinstance(record, OpaqueObject)
    np.testing.assert_array_equal(record.state["x"], np.arange(3.0))


def test_a_pickle_cannot_change_records_for_the_next_one(tmp_path):
    """BUILD on a class sets its attributes; the next load must not see them."""
    module, _, name = FOREIGN.rpartition(".")
    path = tmp_path / "poison.pkl"
    path.write_bytes(f"c{module}\n{name}\n".encode() + b"(N(S'state'\nI7\ndtb.")
    poisoned = load_pickle_or_none(path)
    assert poisoned is None or poisoned.state == 7
    assert OpaqueObject.state is None
    assert load_pickle(written(tmp_path, Foreign()), opaque_classes=[FOREIGN]).state["x"].shape == (3,)


def load_pickle_or_none(path: Path):
    try:
        return load_pickle(path, opaque_classes=[FOREIGN])
    except UserError:
        return None


def test_the_reconstructor_makes_records_alone(tmp_path):
    path = tmp_path / "set.pkl"
    path.write_bytes(b"ccopy_reg\n_reconstructor\n(c__builtin__\nset\nc__builtin__\nobject\nNtR.")
    with pytest.raises(UserError, match=r"copyreg\._reconstructor"):
        load_pickle(path)


def test_bytes_in_other_encodings_are_refused(tmp_path):
    path = tmp_path / "bytes.pkl"
    path.write_bytes(b"c_codecs\nencode\n(S'x'\nS'zlib'\ntR.")
    with pytest.raises(UserError, match="zlib"):
        load_pickle(path)


def test_damaged_and_absent_files_are_named(tmp_path):
    path = written(tmp_path, np.zeros(100))
    whole = path.read_bytes()
    for damaged in (b"", whole[:40], whole[:-1], b"not a pickle", whole.replace(b"f8", b"q9")):
        path.write_bytes(damaged)
        with pytest.raises(UserError, match=r"some\.pkl cannot be read"):
            load_pickle(path)
    with pytest.raises(UserError, match="does not exist"):
        load_pickle(tmp_path / "none.pkl")


@pytest.mark.parametrize("array", [np.arange(6.0).reshape(2, 3), np.array({"a.png": np.eye(3)}, dtype=object)])
def test_npy_files_of_numbers_and_of_objects(tmp_path, array):
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    read = load_npy(tmp_path / "a.npy")
    assert read.shape == array.shape
    np.testing.assert_equal(read.tolist(), array.tolist())


def test_npy_files_run_nothing(tmp_path):
    np.save(tmp_path / "a.npy", np.array(Call(os.system, f"touch {tmp_path / 'marker'}"), dtype=object))
    with pytest.raises(UserError, match=r"a\.npy is refused: it contains `.*system`"):
        load_npy(tmp_path / "a.npy")
    assert not (tmp_path / "marker").exists()
    (tmp_path / "a.npy").write_bytes(b"rubbish")
    with pytest.raises(UserError, match=r"a\.npy cannot be read"):
        load_npy(tmp_path / "a.npy")


def test_every_allowed_name_makes_plain_things_only():
    """Whoever adds a name to the list has to think about it here too."""
    assert sorted({name.rpartition(".")[2] for name in safe_pickle._ALLOWED_GLOBALS}) == [
        "OrderedDict", "_frombuffer", "_reconstruct", "_reconstructor", "bytearray", "complex", "dtype", "encode",
        "frozenset", "ndarray", "object", "scalar", "set",
    ]  # fmt: skip
