// Requests to the service. What it refuses is thrown as an error whose message is the reason.
const JSON_TYPE = "application/json";

export async function send(method, address, body, more = {}) {
  const isJson = body !== undefined && !(body instanceof Blob) && typeof body !== "string";
  const response = await fetch(address, {
    method,
    headers: { ...(isJson ? { "Content-Type": JSON_TYPE } : {}), ...more.headers },
    body: isJson ? JSON.stringify(body) : body,
    signal: more.signal,
  }).catch((error) => {
    if (error.name === "AbortError") throw error;
    throw new Error("The service does not respond; is it still running?");
  });
  if (response.ok) return response;
  const { detail } = await response.json().catch(() => ({}));
  throw new Error(detail ?? `The service responds with status ${response.status}.`);
}

export async function call(method, address, body, more) {
  const response = await send(method, address, body, more);
  return response.status === 204 ? null : response.json();
}

export const get = (address) => call("GET", address);
