"""Result files: what a tracker found, as the benchmarks want it."""

from optipmb_client.results.kitti import KittiResultWriter, read_kitti_results
from optipmb_client.results.rows import ResultTable, ResultWriter, empty_table

__all__ = [
    "KittiResultWriter",
    "ResultTable",
    "ResultWriter",
    "empty_table",
    "read_kitti_results",
]
