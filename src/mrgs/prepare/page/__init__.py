"""The page that shows the results of ``prepare``, and its parts, which other pages share."""
