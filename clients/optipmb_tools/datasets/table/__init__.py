"""Tables of detections: CSV, Parquet, JSON Lines and Feather files of anybody's making."""

from optipmb_tools.datasets.table.dataset import OPTIONS, TableDataset, TableSequence, match_stamps

__all__ = ["OPTIONS", "TableDataset", "TableSequence", "match_stamps"]
