"""Result files in the formats of the benchmarks, and tables of tracks."""

from optipmb_client.results.rows import ResultTable, empty_table

__all__ = ["ResultTable", "empty_table"]
