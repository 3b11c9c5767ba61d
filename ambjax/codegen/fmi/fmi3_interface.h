/* Types and functions of FMI 3.0 for co-simulation, after the standard (fmi-standard.org), version 3.0. */

#ifndef FMI3_INTERFACE_H
#define FMI3_INTERFACE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#if defined(_WIN32)
#define EXPORTED __declspec(dllexport)
#elif defined(__GNUC__)
#define EXPORTED __attribute__((visibility("default")))
#else
#define EXPORTED
#endif

typedef void *instance_t;
typedef void *environment_t;
typedef void *saved_t;
typedef uint32_t reference_t;
typedef enum { OK = 0, WARNING = 1, DISCARD = 2, ERROR = 3, FATAL = 4 } status_t;
typedef void (*log_t)(environment_t environment, status_t status, const char *category, const char *message);
typedef void (*intermediate_t)(environment_t, double, bool, bool, bool, bool, bool *, double *);

#endif
