"""Result files: what a tracker found, as the benchmarks want it."""

from optipmb_client.results.rows import ResultTable, ResultWriter, empty_table

__all__ = ["ResultTable", "ResultWriter", "empty_table"]
