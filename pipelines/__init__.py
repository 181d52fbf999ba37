"""From photos to a report.

``steps`` holds the steps, one file each; ``planning`` joins them to graphs; ``publishing`` shows what they gave;
``cli`` is the command line.
"""
