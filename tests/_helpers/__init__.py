"""What tests of several modules share; fixtures are in the conftest.py of each folder."""
