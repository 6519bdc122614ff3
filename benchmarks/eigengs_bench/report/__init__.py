"""How rows are told: tables, charts, and the page of both."""
