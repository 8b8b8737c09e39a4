// Who is signed in, as the service says. The token itself is in a cookie that scripts cannot read.

export const session = {required: false, role: null};

export function setSession(found) {
  Object.assign(session, found);
}

export const mayAct = () => session.role === "operator";
