"""Large tables of text, which are read in blocks."""

from pathlib import Path

import numpy as np
import pytest

from converters._tables.files.formats import load
from converters._tables.text import blocks, delimited

HEADER = "time,gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2],activity"


def rows(count: int) -> list[str]:
    return [
        f"{1_700_000_000 + k // 100}.{k % 100:02d}1,{0.1 * np.sin(k):.4f},0,{k},0.1,0.2,9.81,{'run' if k > 50 else 'walk'}"
        for k in range(count)
    ]


@pytest.mark.parametrize(
    "last",
    [
        [],
        ["1.0,2.0"],
        [HEADER],
        ["ERR" + rows(1)[0]],
        [rows(1)[0].replace("0.2", "0.2µ")],
        [rows(1)[0].replace(",0,", ",0.5,")],
    ],
    ids=["plain", "short row", "header again", "no number", "no ASCII", "no whole number"],
)
def test_blocks_give_the_columns_of_the_whole_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, last: list[str]) -> None:
    path = tmp_path / "imu.csv"
    path.write_text("\n".join([HEADER, *rows(1500), *last, *rows(2000)[1500:]]) + "\n", encoding="utf-8")
    whole = load(path, "csv")
    monkeypatch.setattr(blocks, "BLOCK", 1 << 15)
    found = load(path, "csv")
    assert [*found.values] == [*whole.values]
    for name, values in whole.values.items():
        assert found.values[name].dtype == values.dtype
        assert found.values[name].tobytes() == values.tobytes()
    assert [texts[-1] for texts in found.texts.values()] == [texts[-1] for texts in whole.texts.values()]
    assert {name: [*texts] for name, texts in found.texts.items()} == {name: [*texts] for name, texts in whole.texts.items()}
    assert (found.units, found.labels, found.numbers) == (whole.units, whole.labels, whole.numbers)
    assert (found.remarks.notes, found.remarks.losses) == (whole.remarks.notes, whole.remarks.losses)


def test_text_of_a_large_table_is_never_in_memory_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "imu.csv"
    path.write_text("\n".join([HEADER, *rows(2000)]) + "\n", encoding="utf-8")
    monkeypatch.setattr(blocks, "BLOCK", 1 << 15)
    monkeypatch.setattr(delimited, "read_csv", None)
    assert len(load(path, "csv").values["time"]) == 2000
