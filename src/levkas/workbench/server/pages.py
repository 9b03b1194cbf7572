"""The page of the workbench: no data in it; all text comes later, as text."""

PAGE = """\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="robots" content="noindex">
<title>Levkas workbench</title>
<link rel="icon" href="data:,">
<link rel="stylesheet" href="/assets/workbench.css">
<script src="/assets/workbench.js" defer></script>
</head>
<body>
<noscript>The workbench needs JavaScript; nothing is loaded from anywhere else.</noscript>
</body>
</html>
"""
