from hypothesis import settings

# How long an example takes depends on the machine and on what is compiled first.
settings.register_profile("arctrack", deadline=None)
settings.load_profile("arctrack")
