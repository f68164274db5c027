"""The pages, tables and figures of `fmu paper`.

Reading order: page, tables, figures, summary_page.
"""
