"""Reports of rows: tables, charts, and the page of both."""
