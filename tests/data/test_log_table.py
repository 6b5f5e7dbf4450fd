"""Parsing of log files into cells and numbers: quotes, comments, decimal commas, other columns."""

import gzip

import pytest

from torchrl_h2o.data import Column, DataError, LogColumns
from torchrl_h2o.data.readers.log_table import read_table

COLUMNS = (Column("q", "observation"), Column("u", "action"))


def table(tmp_path, text, **options):
    path = tmp_path / "log.csv"
    path.write_text(text)
    found = read_table(path, LogColumns(COLUMNS, dt=0.01, **{"separator": ",", "header": True, **options}))
    return found.columns(["q", "u"]).tolist(), found.rows.tolist()


def test_quoted_cells_may_hold_the_separator(tmp_path):
    text = '"u", "note, long", "q"\r\n"1", "a, ""b""", "2.5"\r\n3,,4\r\n'
    assert table(tmp_path, text, other_columns="ignore") == ([[2.5, 1], [4, 3]], [2, 3])


@pytest.mark.parametrize("line", ['1,"2', '"1"0,2', '"1,2'])
def test_broken_quotes_are_named_by_their_line(tmp_path, line):
    with pytest.raises(DataError, match="cannot be split into cells") as caught:
        table(tmp_path, f"q,u\n1,2\n{line}\n3,4\n")
    assert caught.value.row == 3


@pytest.mark.parametrize("separator", [";", "\t", " ", "|"])
def test_any_character_separates(tmp_path, separator):
    text = "q,u\n1,2\n-3,4e-1\n".replace(",", separator)
    assert table(tmp_path, text, separator=separator)[0] == [[1, 2], [-3, 0.4]]


@pytest.mark.parametrize("separator", [",", "whitespace"])
def test_comments_are_skipped_when_asked_for_and_counted_as_lines(tmp_path, separator):
    text = "# robot 7\nq,u\n1,2\n  # paused\n3,4\n"
    text = text.replace(",", " ") if separator == "whitespace" else text
    assert table(tmp_path, text, separator=separator, comment="#") == ([[1, 2], [3, 4]], [3, 5])
    with pytest.raises(DataError):
        table(tmp_path, text, separator=separator)


def test_decimal_comma_is_read_when_asked_for(tmp_path):
    text = "q;u\n1,5;-2\n3e-1;,25\n"
    assert table(tmp_path, text, separator=";", decimal=",")[0] == [[1.5, -2], [0.3, 0.25]]
    with pytest.raises(DataError, match=r"'1,5' is not a number; .*decimal \('.'\)"):
        table(tmp_path, text, separator=";")
    with pytest.raises(
        DataError, match=r"'1\.500' is not a number"
    ) as caught:  # ambiguous: thousands or a decimal point
        table(tmp_path, text.replace("1,5", "1.500"), separator=";", decimal=",")
    assert (caught.value.column, caught.value.row) == ("q", 2)


def test_other_columns_are_ignored_when_asked_for(tmp_path):
    text = "mode,q,mode,u\nidle,1,a,2\nrun,3,b,4\n"
    assert table(tmp_path, text, other_columns="ignore")[0] == [[1, 2], [3, 4]]
    with pytest.raises(DataError, match="other_columns: ignore"):
        table(tmp_path, text.replace(",mode", ",more"))
    with pytest.raises(DataError, match="two columns have this name"):
        table(tmp_path, text.replace("mode,q", "q,q"), other_columns="ignore")
    with pytest.raises(DataError, match="the column is missing"):
        table(tmp_path, text.replace(",u", ",v"), other_columns="ignore")
    with pytest.raises(DataError, match="has 3 columns, 4 are expected"):
        table(tmp_path, text.replace("run,", ""), other_columns="ignore")


def test_underscore_in_a_number_is_refused(tmp_path):
    with pytest.raises(DataError, match="'1_5' is not a number") as caught:
        table(tmp_path, "q,u\n1,2\n3,1_5\n")
    assert (caught.value.column, caught.value.row) == ("u", 3)


def test_compressed_file_is_named_under_any_name(tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes(gzip.compress(b"q,u\n1,2\n3,4\n"))
    with pytest.raises(DataError, match="compressed with gzip; unpack"):
        read_table(path, LogColumns(COLUMNS, dt=0.01, separator=",", header=True))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"comment": "//"}, "comment '//' must be one character"),
        ({"comment": " "}, "comment ' ' must be one character"),
        ({"decimal": ";"}, "decimal ';' must be one of"),
        ({"decimal": ",", "separator": ","}, "decimal and separator are both ','"),
        ({"other_columns": "drop"}, "other_columns 'drop' must be one of"),
        ({"other_columns": "ignore"}, "other_columns: ignore requires a header"),
        ({"separator": '"'}, "cannot separate cells"),
    ],
)
def test_contradicting_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        LogColumns(COLUMNS, dt=0.01, **options)
