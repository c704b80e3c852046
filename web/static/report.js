// The report's page: its button prints it.
document.getElementById("print").addEventListener("click", () => print());
