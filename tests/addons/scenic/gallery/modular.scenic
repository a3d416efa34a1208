# A scenario made of parts.
scenario Main():
    setup:
        ego = new Object at Range(-1, 1) @ 0, with width 2, with length 4
        lead = new Object ahead of ego by Range(5, 15), with width 2, with length 4
        require lead.position.y < 17
