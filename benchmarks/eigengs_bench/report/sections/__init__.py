"""Tables and charts of the rows of each experiment."""
