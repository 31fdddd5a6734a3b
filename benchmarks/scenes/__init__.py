"""Scenes that charts, notebooks and tests share."""
