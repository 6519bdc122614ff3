"""What cameras see of a texture in a Mitsuba scene."""
