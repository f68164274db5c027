"""Write the page and the files for a planned test."""
