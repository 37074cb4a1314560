// Field tables for src/wire.js, from the interface files: all that the browser has to know of them, and no parser.
import protobuf from 'protobufjs';

export const tableRoots = ['PlayResponse', 'ReplicaFrame', 'LayoutUpdate', 'GetWorldResponse', 'RegionStatus', 'Input'];

// {message: [[number, name, kind, repeated, message or '', optional], ...]} of the roots and all that they hold.
export function fieldTables(root) {
  const tables = {};
  const visit = (type) => {
    const name = type.fullName.replace(/^\./, '');
    if (tables[name]) return name;
    const rows = (tables[name] = []);
    for (const field of type.fieldsArray) {
      field.resolve();
      if (field.map) throw new Error(`${name}.${field.name}: maps are not supported`);
      const inner = field.resolvedType;
      const kind = inner === null ? field.type : inner instanceof protobuf.Enum ? 'int32' : 'message';
      const optional = Boolean(field.options?.proto3_optional);
      rows.push([field.id, field.name, kind, field.repeated, kind === 'message' ? visit(inner) : '', optional]);
    }
    return name;
  };
  for (const name of tableRoots) visit(root.lookupType(`aureole.v1.${name}`));
  return tables;
}
