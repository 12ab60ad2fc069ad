"""The console: index, exports, API and page, with a station of its own."""
