"""Figures and pages: numbers in, pictures and one self-contained HTML file out.

Nothing here knows what the numbers mean to the rest of gsfluent, so that a recorded line can be
drawn again without computing anything. matplotlib is imported when something is drawn.
"""
