"""The page and the files for a planned test."""
