"""The Wireshark dissector, made from the same table as the codec.

`python -m host_tools.dissector` writes host_tools/wireshark/fathomlink.lua again.
"""

from pathlib import Path

from host_tools.capture import FATES
from protocol.layouts import fingerprint, placed_fields
from protocol.packets import BODY_BYTES, VERSION, Profile

FOLDER = Path(__file__).parent / "wireshark"
_COLUMNS = {
    "trajectory": "STATE",
    "states": "STATE",
    "points_ned_m": "POINT",
    "hyperparameters": "HYPER",
}


def script() -> str:
    """Return the text of the dissector."""
    text = (FOLDER / "fathomlink.lua.in").read_text()
    parts = {
        "VERSION": str(VERSION),
        "FINGERPRINT": fingerprint(),
        "PROFILES": _table({int(p): f'"{p.name}"' for p in Profile}),
        "BODY_BYTES": _table({int(p): str(BODY_BYTES[p]) for p in Profile}),
        "FATES": _table({i: f'"{fate}"' for i, fate in enumerate(FATES)}),
        "BODIES": _table({int(p): _body(p) for p in Profile}),
    }
    for key, value in parts.items():
        text = text.replace(f"@{key}@", value)
    return text


def main() -> None:
    """Write the dissector."""
    (FOLDER / "fathomlink.lua").write_text(script())


def _table(entries: dict[int, str]) -> str:
    return "\n".join(f"    [{key}] = {value}," for key, value in entries.items())


def _body(profile: Profile) -> str:
    lines = []
    for offset, size, name, kind, count in placed_fields(profile):
        place = f"range({offset}, {size})"
        if kind == "f4" and count > 1:
            lines.append(f'floats(tree, {place}, "{name}", {_COLUMNS[name]})')
        elif kind == "f4":
            lines.append(f'tree:add(f.value, {place}):prepend_text("{name} ")')
        elif kind == "u2":
            lines.append(f'tree:add(f.number, {place}):prepend_text("{name} ")')
        else:
            lines.append(f'tree:add(f.body, {place}):prepend_text("{name} ")')
    body = "\n".join(f"        {line}" for line in lines)
    return f"function(tree, range)\n{body}\n    end"


if __name__ == "__main__":
    main()
