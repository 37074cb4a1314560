import { defineConfig } from 'vite';
import { loadProto } from './gateway/proto.js';
import { fieldTables } from './scripts/tables.js';

// The page gets the field tables of the interface files as a module, made anew with each build.
const name = 'virtual:field-tables';
const fieldTablesPlugin = {
  name: 'field-tables',
  resolveId: (id) => (id === name ? `\0${name}` : undefined),
  load: (id) => (id === `\0${name}` ? `export default ${JSON.stringify(fieldTables(loadProto()))};` : undefined),
};

export default defineConfig({
  base: './',
  plugins: [fieldTablesPlugin],
  build: { target: 'es2022', chunkSizeWarningLimit: 1200, modulePreload: { polyfill: false }, assetsInlineLimit: 0 },
});
