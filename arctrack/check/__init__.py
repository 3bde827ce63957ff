"""Does a recording fit its setup, and if not, which common mistake makes it fit?"""
