"""The command `optipmb`: data sets, offline tracking, replay, evaluation, tuning, recordings and views."""
