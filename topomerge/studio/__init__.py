"""The studio: a page in the browser that shows the maps of a folder, corrects and merges them."""
