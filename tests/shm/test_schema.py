"""Layouts: the offsets of C's natural alignment, the same in NumPy and struct, and a hash that notices."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surffollow.errors import SchemaError
from surffollow.shm import board_regions, layout_board, layout_follow, layout_slot, map_layout
from surffollow.shm.dtypes import numpy_dtype, zeros
from surffollow.shm.schema import (
    F32,
    F64,
    I8,
    I16,
    I32,
    I64,
    SCALARS,
    U8,
    U16,
    U32,
    U64,
    Nested,
    Schema,
    Text,
)

MAKERS = {"f8": F64, "f4": F32, "i8": I64, "u8": U64, "i4": I32, "u4": U32, "i2": I16, "u2": U16}
MAKERS |= {"i1": I8, "u1": U8}


def declared(*modules):
    """Every schema that the modules declare."""
    found = {}
    for module in modules:
        for value in vars(module).values():
            if isinstance(value, type) and issubclass(value, Schema) and value is not Schema:
                found[value.__name__] = value
    return list(found.values())


OURS = declared(layout_follow, layout_board, layout_slot, map_layout)


def schema_of(name, fields):
    return type(name, (Schema,), dict(fields))


scalar_fields = st.builds(
    lambda code, count: MAKERS[code](count), st.sampled_from(sorted(MAKERS)), st.integers(1, 5)
)
text_fields = st.integers(1, 13).map(Text)


def named(fields):
    return [(f"f{k}", f) for k, f in enumerate(fields)]


inner_schemas = st.lists(st.one_of(scalar_fields, text_fields), min_size=1, max_size=4).map(
    lambda fields: schema_of("Inner", named(fields))
)
nested_fields = st.builds(Nested, inner_schemas, st.integers(1, 3))
schemas = st.lists(st.one_of(scalar_fields, text_fields, nested_fields), min_size=1, max_size=8).map(
    lambda fields: schema_of("Made", named(fields))
)


def c_type(schema, name, done, out):
    """Plain C structures, without any padding or alignment of ours."""
    lines = []
    for f in schema.FIELDS:
        if f.nested is not None:
            kind = f"{name}_{f.name}"
            c_type(f.nested, kind, done, out)
        else:
            kind = "char" if f.is_text else SCALARS[f.code][2]
        align = f"_Alignas({f.extra_align}) " if f.extra_align else ""
        lines.append(f"{align}{kind} {f.name}{f'[{f.count}]' if f.count > 1 else ''};")
    out.append(f"typedef struct {{ {' '.join(lines)} }} {name};")
    done.append((name, schema))


def c_offsets(tmp_path, pairs):
    """Layout by the C compiler: name → (size, alignment, offsets)."""
    out, done = [], []
    for name, schema in pairs:
        c_type(schema, name, done, out)
    rows = []
    for name, schema in done:
        offsets = ", ".join(f"offsetof({name}, {f.name})" for f in schema.FIELDS)
        form = ", ".join("%zu" for _ in schema.FIELDS)
        line = f'"[\\"{name}\\", %zu, %zu, [{form}]]\\n", sizeof({name}), _Alignof({name}), {offsets}'
        rows.append(f"  printf({line});")
    source = "#include <stddef.h>\n#include <stdint.h>\n#include <stdio.h>\n" + "\n".join(out)
    source += "\nint main(void) {\n" + "\n".join(rows) + "\n  return 0;\n}\n"
    (tmp_path / "layout.c").write_text(source)
    subprocess.run(
        ["cc", "-std=c11", "-o", tmp_path / "layout", tmp_path / "layout.c"], check=True, capture_output=True
    )
    text = subprocess.run([tmp_path / "layout"], check=True, capture_output=True, text=True).stdout
    said = {row[0]: row[1:] for row in map(json.loads, text.splitlines())}
    return [(name, schema, said[name]) for name, schema in done]


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc) here")
def test_every_layout_of_ours_is_what_the_c_compiler_makes_of_the_same_fields(tmp_path):
    assert len(OURS) > 12
    for name, schema, (size, align, offsets) in c_offsets(tmp_path, [(s.__name__, s) for s in OURS]):
        assert (size, align) == (schema.SIZE, schema.ALIGN), name
        assert [f.offset for f in schema.FIELDS] == offsets, name


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc) here")
def test_invented_layouts_are_what_the_c_compiler_makes_of_the_same_fields(tmp_path):
    rng = np.random.default_rng(11)
    codes = sorted(MAKERS)

    def invent(k):
        fields = [MAKERS[rng.choice(codes)](int(rng.integers(1, 4))) for _ in range(rng.integers(1, 9))]
        if rng.random() < 0.4:
            fields.insert(int(rng.integers(0, len(fields))), Text(int(rng.integers(1, 12))))
        if k > 5 and rng.random() < 0.5:
            fields.insert(int(rng.integers(0, len(fields))), Nested(made[-1][1], int(rng.integers(1, 4))))
        if rng.random() < 0.2:
            fields.append(I64(align=64))
        return schema_of(f"S{k}", named(fields))

    made = []
    for k in range(60):
        made.append((f"S{k}", invent(k)))
    for name, schema, (size, align, offsets) in c_offsets(tmp_path, made):
        assert (schema.SIZE, schema.ALIGN, [f.offset for f in schema.FIELDS]) == (size, align, offsets), name


def assert_numpy_agrees(schema):
    dtype = numpy_dtype(schema)
    assert dtype.itemsize == schema.SIZE
    for f in schema.FIELDS:
        kind, offset = dtype.fields[f.name][:2]
        assert offset == f.offset
        assert kind.itemsize == f.size
        if f.nested is not None:
            assert_numpy_agrees(f.nested)


@pytest.mark.parametrize("schema", OURS, ids=lambda s: s.__name__)
def test_numpy_sees_every_layout_of_ours_at_the_same_offsets(schema):
    assert_numpy_agrees(schema)


@settings(max_examples=200, deadline=None)
@given(schemas)
def test_offsets_are_natural_ascending_and_the_same_in_numpy_and_struct(schema):
    end = 0
    for f in schema.FIELDS:
        assert f.offset >= end
        assert f.offset % f.align == 0
        assert f.offset - end < f.align, "more padding than the alignment asks for"
        end = f.offset + f.size
    assert schema.SIZE % schema.ALIGN == 0
    assert 0 <= schema.SIZE - end < schema.ALIGN
    assert_numpy_agrees(schema)
    whole = schema.struct_of(schema.FIELDS[0].name, schema.FIELDS[-1].name)
    assert whole.size == end


@settings(max_examples=100, deadline=None)
@given(schemas, st.randoms(use_true_random=False))
def test_what_numpy_writes_struct_reads(schema, random):
    record = zeros(schema)
    raw = bytes(random.randrange(256) for _ in range(schema.SIZE))
    record.view(np.uint8)[:] = np.frombuffer(raw, np.uint8)
    for name, offset, f in schema.walk():
        at = record[0]
        for step in name.split("."):
            key = step.removesuffix("[0]")
            at = at[key][0] if step.endswith("[0]") else at[key]
        if f.is_text:
            assert bytes(at) == raw[offset : offset + f.size].rstrip(b"\0"), name
        else:
            values = struct.unpack_from("<" + f.struct_format, raw, offset)
            read, written = np.array(values, np.dtype(f.code)), np.asarray(at)
            if f.code == "f4":  # struct reads it by way of a double, which quiets a signalling NaN
                read, written = read[~np.isnan(read)], written[~np.isnan(written)]
            assert read.tobytes() == written.tobytes(), name


def test_offsets_of_paths_go_through_nested_arrays():
    class Inner(Schema):
        a = U8()
        b = F64(3)

    class Outer(Schema):
        head = U32()
        inner = Nested(Inner, 4)

    assert (Inner.SIZE, Inner.offset("b"), Inner.offset("b", 2)) == (32, 8, 24)
    assert Outer.offset("inner", 3, "b", 1) == 8 + 3 * 32 + 16
    assert numpy_dtype(Outer)["inner"].shape == (4,)
    for path in (("inner", 4), ("inner", -1), ("nothing",), ("head", "a")):
        with pytest.raises(SchemaError):
            Outer.offset(*path)


def test_the_hash_notices_names_types_counts_units_order_and_nested_changes():
    def made(*fields):
        return schema_of("S", fields).HASH

    base = made(("a", F64(unit="m")), ("b", I64()))
    assert base == made(("a", F64(unit="m")), ("b", I64()))
    changed = [
        made(("a2", F64(unit="m")), ("b", I64())),
        made(("a", I64(unit="m")), ("b", I64())),
        made(("a", F64(2, unit="m")), ("b", I64())),
        made(("a", F64(unit="mm")), ("b", I64())),
        made(("b", I64()), ("a", F64(unit="m"))),
        made(("a", F64(unit="m")), ("b", I64(align=64))),
        made(("a", Nested(schema_of("N", [("x", F64())]))), ("b", I64())),
        made(("a", Nested(schema_of("N", [("x", I64())]))), ("b", I64())),
    ]
    assert len({base, *changed}) == len(changed) + 1
    assert made(("a", F64(unit="m", doc="other words")), ("b", I64())) == base


def test_a_renamed_layout_that_names_its_former_names_keeps_its_hash():
    class Old(Schema):
        beat_ns = I64(unit="ns")

    class New(Schema):
        HASHED_AS: ClassVar = {"": "Old", "heartbeat_ns": "beat_ns"}
        heartbeat_ns = I64(unit="ns")

    class Forgotten(Schema):
        heartbeat_ns = I64(unit="ns")

    assert New.HASH == Old.HASH != Forgotten.HASH
    assert New.offset("heartbeat_ns") == 0


@pytest.mark.parametrize("name", ["class", "_hidden", "größe"])
def test_names_that_c_or_python_cannot_use_are_refused(name):
    with pytest.raises(SchemaError):
        schema_of("S", [(name, F64())])


def test_schemas_that_make_no_layout_are_refused():
    with pytest.raises(SchemaError):
        schema_of("Empty", [])
    with pytest.raises(SchemaError):
        schema_of("Huge", [("a", F64(1 << 40))])
    for make in (lambda: F64(0), lambda: F64(-1), lambda: F64(2.5), lambda: I64(align=3)):
        with pytest.raises(SchemaError):
            make()


def test_every_parameter_is_one_word_and_has_a_specification_within_its_bounds():
    from surffollow.config.params import PARAMS

    for f in layout_follow.Params.FIELDS:
        assert f.item_size == 8, f.name
    for name, spec in PARAMS.items():
        field = layout_follow.Params.field(name)
        assert field.count == 1
        assert spec.low <= spec.default <= spec.high, name
        assert spec.whole == (field.code == "i8"), name


def test_board_parts_do_not_overlap_and_begin_on_pages():
    regions = board_regions.board_regions(1 << 16)
    end = layout_board.BoardHeader.SIZE
    for name, (offset, size) in regions.items():
        assert offset % layout_board.PAGE == 0, name
        assert offset >= end, name
        end = offset + size
    assert end <= board_regions.board_bytes(1 << 16)
    assert len(regions) <= layout_board.BoardHeader.field("region").count
