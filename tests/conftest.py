"""What all tests share: a property that holds may take its time."""

from hypothesis import settings

pytest_plugins = ["tests.run_fixtures"]

settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")
