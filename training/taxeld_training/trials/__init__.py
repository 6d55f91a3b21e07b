"""Questions and their answers: trials of the harness, figures, tables, charts and pages."""
