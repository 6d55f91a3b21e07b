"""Questions, and what their trials answer: figures, tables, charts and pages."""
