"""Reports: HTML pages, figures, and exports of the updated model.

Reading order: run (a trace with its diagnosis), document (the parts of a page), sections, plots, pages,
check_page, export.
"""
