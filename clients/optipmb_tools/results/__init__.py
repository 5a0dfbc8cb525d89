"""Result files in the formats of the benchmarks, and tables of tracks."""

from optipmb_tools.results.rows import ResultTable, empty_table

__all__ = ["ResultTable", "empty_table"]
