"""The page and the files of a planned test."""
