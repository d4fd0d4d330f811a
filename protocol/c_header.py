"""The C99 codec, made from the same table as everything else.

`python -m protocol.c_header` writes protocol/c/fathomlink_wire.h again from wire.h.in; a test holds
the file to it, compiles it and runs it against the golden vectors.
"""

from pathlib import Path

from protocol.crc import crc32c
from protocol.layouts import body_table, fingerprint, placed_fields
from protocol.packets import BODY_BYTES, VERSION, Profile

FOLDER = Path(__file__).parent / "c"
_C_TYPES = {"f4": "float", "u2": "uint16_t", "byte": "uint8_t"}
_MUST_BE_FINITE = ("north_m", "east_m", "leader_north_m", "leader_east_m")


def header() -> str:
    """Return the text of the C header."""
    text = (FOLDER / "wire.h.in").read_text()
    parts = {
        "VERSION": str(VERSION),
        "FINGERPRINT": fingerprint(),
        "PROFILES": ",\n".join(f"    FL_{p.name} = {int(p)}" for p in Profile),
        "STRUCTS": "\n\n".join(_struct(p) for p in Profile),
        "MEMBERS": "\n".join(f"    struct {_name(p)} {p.name.lower()};" for p in Profile),
        "BODY_BYTES": "\n".join(f"    case FL_{p.name}: return {BODY_BYTES[p]};" for p in Profile),
        "CRC_TABLE": _crc_table(),
        "READS": "\n".join(_case(p, _reads(p)) for p in Profile),
        "WRITES": "\n".join(_case(p, _writes(p)) for p in Profile),
    }
    for key, value in parts.items():
        text = text.replace(f"@{key}@", value)
    return text


def main() -> None:
    """Write the header into protocol/c."""
    (FOLDER / "fathomlink_wire.h").write_text(header())


def _name(profile: Profile) -> str:
    return f"fl_{profile.name.lower()}"


def _struct(profile: Profile) -> str:
    rows = []
    for name, kind, count in body_table(profile):
        if kind != "zero":
            rows.append(f"    {_C_TYPES[kind]} {name}{f'[{count}]' if count > 1 else ''};")
    return f"struct {_name(profile)} {{\n" + "\n".join(rows) + "\n};"


def _case(profile: Profile, lines: list[str]) -> str:
    body = "\n".join(f"        {line}" for line in lines)
    return f"    case FL_{profile.name}: {{\n{body}\n        break;\n    }}"


def _reads(profile: Profile) -> list[str]:
    lines = [f"struct {_name(profile)} *to = &body->{profile.name.lower()};"]
    for offset, _, name, kind, count in placed_fields(profile):
        if kind == "f4":
            target = f"to->{name}" if count > 1 else f"&to->{name}"
            lines.append(f"fl_get_f4(at + {offset}, {target}, {count});")
        elif kind == "u2":
            lines.append(f"to->{name} = fl_get_u2(at + {offset});")
        elif kind == "byte":
            lines.append(f"memcpy(to->{name}, at + {offset}, {count});")
        else:
            lines.append(f"for (size_t i = 0; i < {count}; i++)")
            lines.append(f"    if (at[{offset} + i] != 0) return FL_LAYOUT;")
        if name in _MUST_BE_FINITE:
            lines.append(f"if (!fl_is_finite(to->{name})) return FL_LAYOUT;")
        if name.endswith("variance_m2"):
            lines.append(f"if (!(to->{name} >= 0.0f)) return FL_LAYOUT;")
    return lines


def _writes(profile: Profile) -> list[str]:
    lines = [f"const struct {_name(profile)} *from = &body->{profile.name.lower()};"]
    for offset, _, name, kind, count in placed_fields(profile):
        if kind == "f4":
            source = f"from->{name}" if count > 1 else f"&from->{name}"
            lines.append(f"fl_put_f4(at + {offset}, {source}, {count});")
        elif kind == "u2":
            lines.append(f"fl_put_u2(at + {offset}, from->{name});")
        elif kind == "byte":
            lines.append(f"memcpy(at + {offset}, from->{name}, {count});")
        else:
            lines.append(f"memset(at + {offset}, 0, {count});")
    return lines


def _crc_table() -> str:
    """Return the rows of the byte table: the CRC of one byte, less start and final values."""
    # the first byte v meets 0xFF of the start value: crc(v) = table[v ^ 0xFF] ^ 0x00FFFFFF ^ ones
    table = [crc32c(bytes([index ^ 0xFF])) ^ 0x00FFFFFF ^ 0xFFFFFFFF for index in range(256)]
    rows = [table[i : i + 6] for i in range(0, 256, 6)]
    return "\n".join("        " + " ".join(f"0x{entry:08X}u," for entry in row) for row in rows)


if __name__ == "__main__":
    main()
