import { defineConfig } from "eslint/config";
import tseslint from "typescript-eslint";

export default defineConfig(
  { ignores: ["node_modules"] },
  {
    files: ["src/**/*.ts", "tests/**/*.ts"],
    extends: [tseslint.configs.strictTypeChecked],
    languageOptions: { parserOptions: { projectService: true } },
    rules: {
      // `values[i]!` where the index is known to be inside: tsconfig sets noUncheckedIndexedAccess.
      "@typescript-eslint/no-non-null-assertion": "off",
      "@typescript-eslint/restrict-template-expressions": ["error", { allowNumber: true }],
      "@typescript-eslint/no-confusing-void-expression": [
        "error",
        { ignoreArrowShorthand: true, ignoreVoidReturningFunctions: true },
      ],
      // `find<HTMLInputElement>(id)`, and what the server or a file is known to answer.
      "@typescript-eslint/no-unnecessary-type-parameters": "off",
      "max-lines": ["error", 400],
      "max-lines-per-function": ["error", 60],
      "max-params": ["error", 8],
      "max-depth": ["error", 5],
    },
  },
  ...["viewer", "workbench", "shared"].map((part) => ({
    files: [`src/${part}/**/*.ts`],
    rules: {
      "no-restricted-imports": [
        "error",
        {
          patterns: ["viewer", "workbench"]
            .filter((other) => other !== part)
            .map((other) => ({
              group: [`**/${other}/*`],
              message: "What both pages use stands in shared/.",
            })),
        },
      ],
    },
  })),
);
