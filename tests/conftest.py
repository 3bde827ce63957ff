from hypothesis import settings

# How long an example takes depends on the machine and on what is compiled first. The same code gives the same
# verdict; other examples than always the same are drawn with --hypothesis-profile explore.
settings.register_profile("explore", deadline=None, derandomize=False)
settings.register_profile("arctrack", deadline=None, derandomize=True)
settings.load_profile("arctrack")
